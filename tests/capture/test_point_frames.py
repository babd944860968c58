"""The point source in a session: recorded at its start, and calibrated from its file."""

from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
import torch

from mwdn import Calibration
from mwdn.calibration.camera_file import read_camera
from mwdn.capture.display import RigDisplay
from mwdn.capture.patterns import point
from mwdn.capture.recipe import read_capture_recipe
from mwdn.capture.session import Session
from mwdn.capture.set_up import open_camera, open_lamp
from mwdn.errors import CameraError, ParameterError
from mwdn.optics.displacement import displacement

TABLES = {
    "camera": {"source": "rig"},
    "display": {"kind": "rig", "width_px": 120, "height_px": 90, "width_cm": 24.0, "height_cm": 18.0},
    "pictures": {"folder": "photos", "size": [84, 84], "count": 1},
    "session": {"settle_s": 0.0, "references_every": 0, "patterns": ["none"]},
    "point": {"frames": 5, "size_cm": 0.2},
    "rig": {"height": 48, "width": 64, "fill": 0.9, "room_light": 0.0, "display_black": 0.0, "latency": 1},
}


@pytest.fixture
def recipe(tmp_path):
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "grey.png"), np.full((84, 84, 3), 128, np.uint8))
    return replace(read_capture_recipe("capture-rig", **TABLES), folder=tmp_path)


def session(recipe, out):
    camera = open_camera(recipe)
    camera.open()
    lamp = open_lamp(camera, lambda task: None)
    return camera, Session(recipe, camera, RigDisplay(camera), out, wait=lambda _: None, lamp=lamp)


def exact(recipe):
    """The light of the point alone: a frame without noise, less one of a dark display, (1, 3, H, W)."""
    options = replace(recipe.rig, full_well=1e9, read_noise=0.0, bit_depth=16, latency=0, drop=0.0)
    rig = open_camera(replace(recipe, rig=options))
    frames = []
    with rig:
        rig.configure(exposure_s=1.0)
        for picture in (point(rig.screen, recipe.point.size_cm), np.zeros((90, 120, 3), np.uint8)):
            rig.show(picture)
            frames.append(torch.from_numpy(rig.read().array.astype(np.float32)))
    return (frames[0] - frames[1]).movedim(-1, 0)[None]


def test_a_session_with_a_lamp_becomes_a_camera_file(tmp_path, run, recipe):
    """In a lit room, in front of a display whose black glows."""
    expected = exact(replace(recipe, point=replace(recipe.point, size_cm=0.1)))
    lit = replace(recipe.rig, room_light=0.02, display_black=0.001)
    recipe = replace(recipe, rig=lit, point=replace(recipe.point, lamp=True, ratio=60.0))
    rig, made = session(recipe, tmp_path / "captured.h5")
    assert made.run() == 1
    assert rig.exposure_s == pytest.approx(0.01)  # set back
    code, out, err = run("calibrate", tmp_path / "captured.h5", "--no-centre", "-o", tmp_path / "camera.toml")
    assert code == 0, err
    assert "12 frames averaged at 2 exposures" in out
    calibration = Calibration.load(tmp_path / "camera.toml")
    assert displacement(calibration.psf, expected).correlation > 0.99
    assert calibration.sensor.full_well == pytest.approx(15_000, rel=0.1)
    assert calibration.sensor.read_noise == pytest.approx(3, abs=1)  # not the noise of the room's light
    # Black level and room light at the exposure of the pictures, not at the longest of the lamp.
    with h5py.File(tmp_path / "captured.h5") as file:
        dark = file["calibration/dark/measurement"][:].mean() / 4095
        assert file["calibration/dark-2/measurement"][:].mean() / 4095 > 1.1 * dark
    assert float(calibration.dark.mean()) == pytest.approx(dark, rel=1e-3)
    content = read_camera(tmp_path / "camera.toml")
    assert content["bit_depth"] == 12
    assert "flat_field" not in content  # the mask was in front of the sensor
    assert content["dark_exposure"] == pytest.approx(10)
    # The dark frame of the camera file was taken for one of the options, and the session refused.
    again = ("--camera", tmp_path / "camera.toml", "-o", tmp_path / "again.toml")
    assert run("calibrate", tmp_path / "captured.h5", *again)[0] == 0
    (tmp_path / "session").mkdir()
    (tmp_path / "captured.h5").rename(tmp_path / "session" / "captured.h5")
    for options, said in (
        (("--exposures", 1), "Leave those options out"),
        (("--capture-exposure", 1), "Leave those options out"),
        (("--flat", "flat.png"), "`--flat-dark` must name"),  # the session's dark frames have several exposures
    ):
        code, _, err = run("calibrate", tmp_path / "session", *options, "-o", tmp_path / "camera.toml")
        assert code == 2
        assert said in err


def test_it_is_recorded_once_and_not_at_all_unless_asked_for(tmp_path, run, recipe):
    out = tmp_path / "captured.h5"
    plain = replace(recipe, point=replace(recipe.point, frames=0))
    assert session(plain, out)[1].run() == 1
    code, _, err = run("calibrate", out)
    assert code == 2
    assert "has no frames of a point source" in err
    rig, made = session(recipe, out)
    made.run()
    with h5py.File(out) as file:
        frames = [file[f"calibration/{name}/measurement"][:].mean(0) for name in ("point-1", "dark-1")]
        assert file["calibration/point-2"].attrs["exposure_s"] / file["calibration/point-1"].attrs["exposure_s"] == 8
    light = torch.from_numpy((frames[0] - frames[1]).astype(np.float32)).movedim(-1, 0)[None]
    assert displacement(light, exact(recipe)).correlation > 0.999
    before = rig._number
    session(recipe, out)[1].run()
    again, made = session(recipe, out)
    made.run()
    assert again._number < 10 < before


@pytest.mark.parametrize(
    ("rig", "point", "said"),
    [
        ({"room_light": 0.02}, {}, r"other light has .*`lamp = true`"),
        ({"display_black": 0.01}, {}, "other light has"),
        ({}, {"most_s": 0.5}, "too faint"),
    ],
)
def test_a_faint_point_is_refused_with_its_reason(tmp_path, recipe, rig, point, said):
    recipe = replace(recipe, rig=replace(recipe.rig, **rig), point=replace(recipe.point, **point))
    with pytest.raises(CameraError, match=said):
        session(recipe, tmp_path / "captured.h5")[1].run()


def test_a_point_that_is_larger_than_the_display_is_refused_before_anything_is_recorded(tmp_path, recipe):
    recipe = replace(recipe, point=replace(recipe.point, size_cm=100.0))
    with pytest.raises(ParameterError, match="size_cm"):
        session(recipe, tmp_path / "captured.h5")
    assert not (tmp_path / "captured.h5").exists()


def test_a_bright_room_adds_nothing_to_the_read_noise(tmp_path, run, recipe):
    """Its photon noise was in it: 6.9 electrons instead of 3."""
    lit = replace(recipe, rig=replace(recipe.rig, room_light=0.1), point=replace(recipe.point, lamp=True, ratio=20.0))
    session(lit, tmp_path / "captured.h5")[1].run()
    assert run("calibrate", tmp_path / "captured.h5", "-o", tmp_path / "camera.toml")[0] == 0
    sensor = Calibration.load(tmp_path / "camera.toml").sensor
    assert sensor.read_noise == pytest.approx(3, abs=0.5)
    assert sensor.black_level == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize("seed", [2, 7])
def test_hot_pixels_are_not_taken_for_the_point(tmp_path, recipe, seed):
    """The search for the exposure took them for its peak, until the point was too faint."""
    rig = replace(recipe.rig, seed=seed, hot_pixels=0.003)
    rig, made = session(replace(recipe, rig=rig, point=replace(recipe.point, lamp=True)), tmp_path / "captured.h5")
    assert made.run() == 1
    with h5py.File(tmp_path / "captured.h5") as file:
        point, dark = (file[f"calibration/{name}/measurement"][:].mean(0).max(-1) for name in ("point-1", "dark-1"))
    assert 0.3 < np.quantile(point - dark, 0.999) / 4095 < 0.95
