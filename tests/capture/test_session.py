"""Sessions on the simulated rig: every pair once, whatever stops them."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
import torch

from full_disk import full_after
from mwdn.capture.display import RigDisplay
from mwdn.capture.gamma import fit_gamma
from mwdn.capture.recipe import CaptureRecipe, read_capture_recipe
from mwdn.capture.rig import Rig
from mwdn.capture.screen import place_picture, put
from mwdn.capture.session import Session
from mwdn.capture.set_up import open_camera
from mwdn.cli.refine import check_pair_file
from mwdn.data import PairFile
from mwdn.data.importers import import_pairs
from mwdn.data.recorded import Division, recorded_pairs
from mwdn.errors import CameraError, DisplayError, ImageError, ParameterError, UnknownNameError

RECIPE = """
[camera]
source = "rig"
[display]
kind = "rig"
width_px = 120
height_px = 90
width_cm = 24.0
height_cm = 18.0
[pictures]
folder = "photos"
size = [80, 80]
count = {count}
[session]
settle_s = 0.0
references_every = 3
patterns = ["dots"]
frames = 2
[rig]
height = 32
width = 32
white = 0.5
latency = 1
full_well = 1e7
{rig}
"""


def write(folder, count=7, rig="", pictures=9):
    """A recipe and its photographs: each has its own colour."""
    (folder / "photos" / "more").mkdir(parents=True, exist_ok=True)
    for number in range(pictures):
        colour = (255 - 6 * number % 240, 6 * number % 240, number)
        picture = np.full((90, 100, 3), colour, np.uint8)
        picture[:, :: number + 2] = 255
        cv2.imwrite(str(folder / "photos" / ("more" if number % 2 else "") / f"{number}.png"), picture)
    path = folder / "recipe.toml"
    path.write_text(RECIPE.format(count=count, rig=rig))
    return path


def session(recipe, out, camera=None, **options):
    camera = camera or open_camera(recipe)
    camera.open()
    return Session(recipe, camera, RigDisplay(camera), out, wait=lambda _: None, **options)


@pytest.fixture
def recipe(tmp_path):
    return read_capture_recipe(write(tmp_path))


def test_a_clock_that_is_set_back_does_not_stop_it(recipe, tmp_path, monkeypatch):
    """No frame would ever begin after a picture that was shown in the future."""
    clock, calls = time.time, 0

    def set_back():
        nonlocal calls
        calls += 1
        return clock() - (3600 if calls > 30 else 0)

    monkeypatch.setattr(time, "time", set_back)
    assert session(recipe, tmp_path / "pairs.h5").run() == 7
    assert calls > 60


def test_fewer_photographs_than_wanted_are_said(tmp_path):
    with pytest.warns(UserWarning, match=r"`count` \(7\) .* is more than the photographs of .* \(3\)"):
        assert session(read_capture_recipe(write(tmp_path, pictures=3)), tmp_path / "pairs.h5").run() == 3


def test_a_display_of_less_than_a_pixel_is_seen(tmp_path):
    assert session(read_capture_recipe(write(tmp_path, rig="fill = 0.0001")), tmp_path / "pairs.h5").run() == 7


def check_pairs(path, recipe, count):
    """Each pair is there once, and its measurement is of its own picture."""
    rig = Rig(replace(recipe.rig, latency=0, drop=0.0, disconnect_every=0, drift=0.0), open_camera(recipe).screen)
    place = place_picture(rig.screen, recipe.pictures.size, recipe.pictures.fill)
    rig.open()
    with h5py.File(path, locking=False) as file, PairFile(path) as pairs:
        names = [name.decode() for name in file["photograph"]]
        gamma = file.attrs["display_gamma"]
        assert len(names) == len(set(names)) == len(pairs) == count
        assert len(file["frame_data/number"]) == count
        for number in range(count):
            measurement, scene = pairs[number]
            shown = np.rint(255 * scene.movedim(0, -1).numpy() ** (1 / gamma)).astype(np.uint8)
            rig.show(put(shown, place, rig.screen))
            wanted = rig.read().array.astype(float)
            error = np.abs(measurement.movedim(0, -1).numpy() * 4095 - wanted)
            assert error.mean() < 0.02 * wanted.mean()
        return names


def test_a_session_records_each_picture_once_with_its_own_frame(tmp_path, recipe):
    out, seen = tmp_path / "pairs.h5", []
    assert session(recipe, out, progress=lambda *state: seen.append(state)).run() == 7
    names = check_pairs(out, recipe, 7)
    assert [name for *_, name in seen] == names
    assert seen[-1][:2] == (7, 7)
    with h5py.File(out, locking=False) as file:
        assert file.attrs["display_gamma"] == pytest.approx(2.2, abs=0.02)
        assert (file.attrs["bit_depth"], file.attrs["mosaic"], file.attrs["width_cm"]) == (12, "", 24.0)
        assert file["photograph"].asstr()[:].tolist() == names  # UTF-8, for other programs, too
        assert file["references/white/before"][:].tolist() == [0, 3, 6]
        assert file["patterns/dots/measurement"].shape == (2, 32, 32, 3)
        assert file["patterns/dots/scene"].shape == (2, 80, 80, 3)
        assert file["patterns/grey/measurement"].shape[0] == 9
        assert (np.diff(file["patterns/grey/measurement"][:].mean((1, 2, 3))) > 0).all()
    with PairFile(out) as pairs:
        assert pairs.scene_shape == (80, 80, 3)
        assert pairs[0][1].max() > 0.9
        assert 0.1 < pairs[0][0].max() <= 1  # the full scale of 12 bits is 1, and not 1/16
    imported = tmp_path / "imported.h5"
    for refused in (
        lambda: recorded_pairs(out, torch.ones(1, 3, 32, 32), Division()),
        lambda: check_pair_file(out),
        lambda: import_pairs("pairs", out, imported),
    ):
        with pytest.raises(ParameterError, match=r"raw frames of 12 bits.*`mwdn align"):
            refused()


def test_a_finished_session_goes_on_with_more_pictures(tmp_path, recipe):
    out = tmp_path / "pairs.h5"
    session(recipe, out).run()
    before = PairFile(out)
    assert session(recipe, out).run() == 7
    more = replace(recipe, pictures=replace(recipe.pictures, count=0))
    assert session(more, out).run() == 9
    check_pairs(out, recipe, 9)
    assert len(before) == 7  # opened before it grew, read after it
    assert before[6][0].shape == (3, 32, 32)
    assert len(PairFile(out)) == 9


def test_lost_frames_disconnections_and_drift_lose_no_pair(tmp_path):
    path = write(tmp_path, rig="drop = 0.3\ndisconnect_every = 11\ndrift = 0.0005")
    recipe, out = read_capture_recipe(path), tmp_path / "pairs.h5"
    with pytest.warns(UserWarning, match="disconnected"):
        assert session(recipe, out).run() == 7
    check_pairs(out, recipe, 7)


def test_a_camera_may_fail_between_the_frames_of_a_pattern(tmp_path, recipe):
    """Only the first frame of each was tried again."""

    class Failing(Rig):
        last, failures = "", 0

        def show(self, picture, **options):
            self.reads = 0
            return super().show(picture, **options)

        def read(self):
            self.reads += 1
            if self.reads == recipe.session.skip + 2 and self.failures < 3:  # the second frame of the same picture
                self.failures += 1
                raise CameraError("rig was disconnected.")
            return super().read()

    out = tmp_path / "pairs.h5"
    with pytest.warns(UserWarning, match="Opened again, attempt 1"):
        assert session(recipe, out, Failing(recipe.rig, open_camera(recipe).screen)).run() == 7
    with h5py.File(out) as file:
        assert {len(group["measurement"]) for name, group in file["patterns"].items() if name != "grey"} == {
            recipe.session.frames
        }


def test_a_camera_that_stays_away_ends_the_session_and_the_next_one_goes_on(tmp_path, recipe):
    class Leaving(Rig):
        reads = 0

        def read(self):
            self.reads += 1
            if self.reads > 45:
                self._is_open = False
                raise CameraError("rig is gone.")
            return super().read()

        def open(self):
            if self.reads > 45:
                raise CameraError("rig is busy.")
            super().open()

    out, screen = tmp_path / "pairs.h5", open_camera(recipe).screen
    with pytest.warns(UserWarning, match="gone"), pytest.raises(CameraError, match="busy"):
        session(recipe, out, Leaving(recipe.rig, screen)).run()
    count = len(PairFile(out))
    assert 0 < count < 7
    assert session(recipe, out).run() == 7
    check_pairs(out, recipe, 7)


def test_frames_of_another_size_end_the_session_and_the_next_one_goes_on(tmp_path, recipe):
    class Binning(Rig):
        reads = 0

        def read(self):
            self.reads += 1
            frame = super().read()
            return frame if self.reads < 45 else replace(frame, array=frame.array[::2, ::2].copy())

    out, screen = tmp_path / "pairs.h5", open_camera(recipe).screen
    with pytest.raises(CameraError, match=r"16, 16.*32, 32.*Set the camera as it was"):
        session(recipe, out, Binning(recipe.rig, screen)).run()
    assert 0 < len(PairFile(out)) < 7
    assert session(recipe, out).run() == 7
    check_pairs(out, recipe, 7)


def test_a_drift_of_the_light_is_warned_of(tmp_path):
    recipe = read_capture_recipe(write(tmp_path, rig="drift = 0.03"), display={"gamma": 2.2})
    with pytest.warns(UserWarning, match=r"display's light has changed by"):
        session(recipe, tmp_path / "pairs.h5").run()


def test_a_name_that_is_not_utf8_is_skipped_and_an_output_folder_is_made(tmp_path, recipe):
    """Both ended in a traceback."""
    shutil.copy(tmp_path / "photos" / "0.png", os.fsencode(tmp_path / "photos") + b"/bad\xff.png")
    everything, out = replace(recipe, pictures=replace(recipe.pictures, count=0)), tmp_path / "new" / "pairs.h5"
    with pytest.warns(UserWarning, match=r"bad\\udcff\.png` is skipped, because its name is not UTF-8"):
        assert session(everything, out).run() == 9
    check_pairs(out, recipe, 9)


def test_a_damaged_photograph_is_skipped_and_named(tmp_path, recipe):
    (tmp_path / "photos" / "3.png").write_bytes(b"nothing")
    (tmp_path / "photos" / "0.png").write_bytes(b"nothing")
    everything = replace(recipe, pictures=replace(recipe.pictures, count=0))
    out = tmp_path / "pairs.h5"
    with pytest.warns(UserWarning, match="skipped"):
        assert session(everything, out).run() == 8
    check_pairs(out, recipe, 8)


def test_a_full_disk_keeps_the_pairs_so_far(tmp_path, recipe):
    out = tmp_path / "pairs.h5"
    session(replace(recipe, pictures=replace(recipe.pictures, count=2)), out).run()
    with full_after(out.stat().st_size + 100_000), pytest.raises(ImageError, match="Make room"):
        session(recipe, out).run()
    assert 2 <= len(PairFile(out)) < 7
    assert session(recipe, out).run() == 7
    check_pairs(out, recipe, 7)


def test_room_is_needed_for_the_wanted_photographs_only(tmp_path, monkeypatch):
    """All of the folder were counted, so that a smaller `count`, the advice of the error, did not help."""
    recipe = read_capture_recipe(write(tmp_path, pictures=20))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 0, 600_000))
    with pytest.raises(ParameterError, match="20 pairs need"):
        session(replace(recipe, pictures=replace(recipe.pictures, count=0)), tmp_path / "all.h5").run()
    assert session(recipe, tmp_path / "pairs.h5").run() == 7


def test_too_little_room_is_noticed_at_the_start(tmp_path, recipe, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**6, 10**6, 10**5))
    with pytest.raises(ParameterError, match=r"pairs need \d+ MB, but .* has 0 MB left"):
        session(recipe, tmp_path / "pairs.h5").run()
    assert not (tmp_path / "pairs.h5").exists()


def test_a_file_of_other_settings_is_not_mixed(tmp_path, recipe):
    out = tmp_path / "pairs.h5"
    session(recipe, out).run()
    content = out.read_bytes()
    for changed in (
        replace(recipe, display=replace(recipe.display, distance_cm=30.0)),
        replace(recipe, pictures=replace(recipe.pictures, fill=0.5)),
        replace(recipe, pictures=replace(recipe.pictures, size=(40, 40))),
        replace(recipe, rig=replace(recipe.rig, bit_depth=10)),
        replace(recipe, rig=replace(recipe.rig, height=recipe.rig.height // 2)),
        replace(recipe, rig=replace(recipe.rig, seed=recipe.rig.seed + 1)),
        replace(recipe, camera=replace(recipe.camera, exposure_s=0.011)),
        replace(recipe, camera=replace(recipe.camera, gain=1.1)),
        replace(recipe, display=replace(recipe.display, gamma=1.8)),
    ):
        with pytest.raises(ParameterError, match="was begun with"):
            session(changed, out).run()
    assert out.read_bytes() == content
    rounded = replace(
        recipe, camera=replace(recipe.camera, exposure_s=0.01, gain=1.0), display=replace(recipe.display, gamma=2.2)
    )
    assert session(rounded, out).run() == 7


def test_frames_in_progress_have_the_old_exposure_and_are_skipped(tmp_path, recipe):
    class Late(Rig):
        """As a Raspberry Pi's camera: the exposure takes effect a few frames after it is set."""

        left = 5

        def read(self):
            self.left -= 1
            frame = super().read()
            return replace(frame, exposure_s=0.003) if self.left >= 0 else frame

    recipe, out = replace(recipe, camera=replace(recipe.camera, exposure_s=0.01)), tmp_path / "pairs.h5"
    for camera in (None, Late(recipe.rig, open_camera(recipe).screen)):
        assert session(recipe, out, camera).run() == 7


def test_wrong_exposures_are_refused_before_anything_is_recorded(tmp_path, recipe):
    for exposure_s, message in ((1.0, "Lower `exposure_s`"), (1e-6, "raise `exposure_s`")):
        changed = replace(recipe, camera=replace(recipe.camera, exposure_s=exposure_s))
        out = tmp_path / f"{exposure_s}.h5"
        with pytest.raises(CameraError, match=message):
            session(changed, out).run()
        assert len(PairFile(out)) == 0
        assert session(recipe, out).run() == 7


KILLS = """
import os, random, signal, sys
from pathlib import Path
from mwdn.capture.display import RigDisplay
from mwdn.capture.recipe import read_capture_recipe
from mwdn.capture.session import Session
from mwdn.capture.set_up import open_camera
from mwdn.data.journal import JournalledFile

def killing(function, left):
    def call(*arguments):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments)
    return call

def run(seed):
    left = [random.Random(seed).randrange(60, 250)]
    os.fsync = killing(os.fsync, left)
    for name in ("write", "apply"):
        setattr(JournalledFile, name, killing(getattr(JournalledFile, name), left))
    recipe = read_capture_recipe(sys.argv[1])
    camera = open_camera(recipe)
    camera.open()
    Session(recipe, camera, RigDisplay(camera), Path(sys.argv[2])).run()

for seed in range(int(sys.argv[3])):
    child = os.fork()  # this process has computed nothing: it has no threads that a child would miss
    if not child:
        try:
            run(seed)
        finally:
            os._exit(1)
    if os.waitpid(child, 0)[1] != signal.SIGKILL:
        sys.exit(f"session {seed} was not killed")
"""
"""Starts a session again and again; each is killed at a random write or flush of the disk."""


def kill_often(tmp_path, kills, count):
    """Kill sessions, then let the last one finish."""
    path, out = write(tmp_path, count=count, pictures=count), tmp_path / "pairs.h5"
    subprocess.run([sys.executable, "-c", KILLS, path, out, str(kills)], check=True, timeout=300)
    assert 0 < len(PairFile(out)) < count
    recipe = read_capture_recipe(path)
    session(recipe, out).run()
    check_pairs(out, recipe, count)


def test_sessions_that_are_killed_lose_and_double_no_pair(tmp_path):
    kill_often(tmp_path, kills=3, count=30)


@pytest.mark.acceptance
def test_twenty_kills_lose_and_double_no_pair(tmp_path):
    kill_often(tmp_path, kills=20, count=200)


def test_gamma_is_fitted_to_grey_steps(generator):
    levels = [0, 32, 64, 96, 128, 160, 192, 224, 255]
    light = [7 + 100 * (level / 255) ** 1.8 for level in levels]
    assert fit_gamma(levels, light).gamma == pytest.approx(1.8, abs=1e-9)
    noisy = np.array(light) + np.random.default_rng(0).normal(0, 0.3, 9)
    assert fit_gamma(levels, noisy.tolist()).gamma == pytest.approx(1.8, abs=0.05)
    bent = [value + 10 * (level == 128) for value, level in zip(light, levels, strict=True)]
    assert fit_gamma(levels, bent).error > 0.05
    for wrong in ([5.0] * 9, light[::-1], [7 + 100 * (level / 255) ** 0.2 for level in levels]):
        with pytest.raises(DisplayError):
            fit_gamma(levels, wrong)


def test_a_folder_is_relative_to_its_recipe_or_to_the_current_one_if_it_is_an_option(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    path = write(tmp_path)
    assert read_capture_recipe(path).photographs == tmp_path / "photos"
    assert read_capture_recipe(path, pictures={"folder": "../photos"}).photographs.samefile(tmp_path / "photos")


def test_a_board_needs_large_pictures_and_is_refused_before_anything_is_recorded(tmp_path, run):
    path, out = write(tmp_path, count=1), tmp_path / "pairs.h5"
    path.write_text(path.read_text().replace('["dots"]', '["dots", "charuco"]'))
    code, _, err = run("capture", path, "-o", out)
    assert code == 2
    assert "(80 x 80)" in err
    assert "84 x 84" in err
    assert not out.exists()
    assert run("capture", path, "-o", out, "--pictures.size", "[90, 90]")[0] == 0


def test_wrong_recipes_are_named(tmp_path):
    path = write(tmp_path)
    assert isinstance(read_capture_recipe(path), CaptureRecipe)
    with pytest.raises(UnknownNameError, match="setle_s"):
        read_capture_recipe(path, session={"setle_s": 1.0})
    with pytest.raises(UnknownNameError, match="picture'"):
        read_capture_recipe(path, picture={})
    with pytest.raises(UnknownNameError, match="dts"):
        read_capture_recipe(path, session={"patterns": ["dts"]})
    with pytest.raises(ParameterError, match="gamma"):
        read_capture_recipe(path, display={"gamma": 9.0})
    with pytest.raises(ParameterError, match="kind"):
        read_capture_recipe(path, display={"kind": "page"})
    with pytest.raises(ParameterError) as wrong:
        read_capture_recipe(path, point={"frames": -2})
    assert str(wrong.value).count("[point]") == 1
    empty = read_capture_recipe(path, pictures={"folder": "none"})
    with pytest.raises(ParameterError, match="none"):
        session(empty, tmp_path / "a.h5").run()
    for name in ("capture", "capture-rig"):
        assert read_capture_recipe(name).camera.source


def test_the_command_captures_and_continues(tmp_path, run):
    recipe, out = write(tmp_path), tmp_path / "pairs.h5"
    code, printed, _ = run("capture", recipe, "-o", out, "--pictures.count", "2")
    assert code == 0
    assert "2 pairs" in printed
    assert "align" in printed
    code, _, errors = run("capture", recipe, "-o", out, "--display.distance-cm", 9)
    assert code == 2
    assert errors.count("\n") == 1
    assert "--display.distance-cm" in errors
