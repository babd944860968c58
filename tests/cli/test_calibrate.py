"""`mwdn calibrate`, and `--camera` in other commands."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration, Camera, read_frame
from mwdn.calibration.camera_file import read_camera, write_camera

SIZE = 64, 80


@pytest.fixture
def folder(tmp_path, monkeypatch, generator):
    """`lab/psf.png` in orange light, and `capture.png` of a grey square in the same light, the last row first."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab").mkdir()
    psf = contour_psf(SIZE, cell=20, generator=generator)
    lamp = torch.tensor([0.9, 0.7, 0.5])[:, None, None]
    scene = torch.zeros(1, 3, *SIZE)
    scene[..., 20:40, 24:44] = 0.9
    for name, image in (("lab/psf.png", 0.9 * psf / psf.max()), ("capture.png", Camera(psf).forward(scene))):
        frame = ((image * lamp)[0].flip(-2).movedim(0, -1).clamp(0, 1) * 65535).numpy().astype(np.uint16)
        assert cv2.imwrite(name, frame[..., ::-1])
    return tmp_path


RECONSTRUCT = "reconstruct capture.png --method wiener --format npy --no-trust --device cpu --out"


def picture(name):
    return read_frame(f"{name}/capture.npy")


@pytest.mark.usefixtures("folder")
def test_camera_file_replaces_the_options(run):
    options = "--background 0 --upside-down --bin 2"
    code, out, err = run(f"calibrate lab/psf.png {options} --white-balance psf --distance-mm 150 -o lab/camera.toml")
    assert (code, err) == (0, "")
    assert "PSF with" in out or "good PSF" in out  # the headline of `mwdn inspect`
    assert "mwdn reconstruct CAPTURES --camera lab/camera.toml" in out
    assert run(f"{RECONSTRUCT} a --psf lab/psf.png {options} --white-balance psf")[0] == 0
    assert run(f"{RECONSTRUCT} b --camera lab/camera.toml")[0] == 0
    np.testing.assert_array_equal(picture("a"), picture("b"))
    red, green, blue = picture("b")[10:20, 12:22].mean((0, 1))
    assert (red, blue) == pytest.approx((green, green), rel=0.01)


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("options", "pitch"), [("--bin 4", 6.0), ("--crop 48 48", 3.0), ("--bin 4 --pitch-um 5", 5.0)])
def test_pitch_follows_a_changed_bin(run, options, pitch):
    """It is the distance between pixels after binning; the new camera file kept that of the old bin."""
    assert run("calibrate lab/psf.png --bin 2 --pitch-um 3 -o camera.toml")[0] == 0
    assert run(f"calibrate --camera camera.toml {options} -o camera.toml")[0] == 0
    assert read_camera("camera.toml")["pitch_um"] == pitch


@pytest.mark.usefixtures("folder")
def test_psf_by_another_path_is_the_camera_files_own():
    """Another spelling made it another PSF: its corrections were applied twice, its refinement was dropped."""
    content = {"psf": Path("lab/psf.png"), "psf_corrected": True, "envelope_shift": (1.0, 2.0)}
    write_camera("camera.toml", content)
    expected = Calibration.load("camera.toml")
    assert expected.refinement
    for path in ("lab/psf.png", Path("lab/psf.png").absolute(), "lab/../lab/psf.png"):
        calibration = Calibration.load("camera.toml", psf=path)
        assert (calibration.psf_hash, calibration.corrections.psf_done) == (expected.psf_hash, True)


@pytest.mark.usefixtures("folder")
def test_options_on_the_command_line_take_precedence(run):
    assert run("calibrate lab/psf.png --background 0 --upside-down --bin 2 --white-balance psf -o camera.toml")[0] == 0
    assert run(f"{RECONSTRUCT} a --psf lab/psf.png --background 0.1 --no-upside-down --bin 4")[0] == 0
    line = f"{RECONSTRUCT} b --camera camera.toml --background 0.1 --no-upside-down --bin 4 --white-balance 1 1 1"
    assert run(line)[0] == 0
    np.testing.assert_array_equal(picture("a"), picture("b"))
    shutil.copy("capture.png", "lab/other.png")
    assert run(f"{RECONSTRUCT} c --camera camera.toml --psf lab/other.png")[0] == 0
    hashes = [json.loads(Path(name, "capture.json").read_text())["psf_hash"] for name in "bc"]
    assert hashes[0] != hashes[1]


@pytest.mark.usefixtures("folder")
def test_none_leaves_out_what_the_camera_file_says(run):
    """There was no way to do without its dark frame but to edit the file."""
    cv2.imwrite("dark.png", np.full((*SIZE, 3), 2000, np.uint16))
    content = {
        "psf": Path("lab/psf.png"),
        "dark": "dark.png",
        "ambient": "dark.png",
        "crop": (48, 48),
        "mosaic": "rggb",
    }
    content |= {"gamma": 2.2, "psf_orientation": "rotate-180", "bit_depth": 14, "white_balance": "psf"}
    write_camera("camera.toml", content)
    without = "--dark none --ambient none --crop none --mosaic none --gamma none --psf-orientation none"
    line = f"{RECONSTRUCT} a --camera camera.toml {without} --bit-depth none --white-balance none"
    code, _, err = run(line)
    assert (code, err) == (0, "")
    assert run(f"{RECONSTRUCT} b --psf lab/psf.png")[0] == 0
    np.testing.assert_array_equal(picture("a"), picture("b"))


@pytest.mark.usefixtures("folder")
def test_camera_file_is_changed_by_calibrating_again(run):
    assert run("calibrate lab/psf.png --bin 2")[0] == 0
    assert run("calibrate --camera camera.toml --gamma 2.2 --pitch-um 4.8")[0] == 0
    camera = read_camera("camera.toml")
    assert (camera["bin"], camera["gamma"], camera["pitch_um"]) == (2, 2.2, 4.8)
    cv2.imwrite("lab/psf.png", cv2.imread("lab/psf.png", -1) // 2)
    assert "has changed since" in run(f"{RECONSTRUCT} a --camera camera.toml")[2]
    assert run("calibrate --camera camera.toml")[0] == 0
    assert run(f"{RECONSTRUCT} a --camera camera.toml")[0] == 0


@pytest.mark.usefixtures("folder")
def test_none_takes_keys_out_of_the_camera_file(run):
    """They stayed, although the command was told to do without them."""
    content = {"psf_gamma": 2.0, "psf_orientation": "rotate-180", "psf_bit_depth": 16}
    content |= {"gamma": 2.2, "bit_depth": 14, "crop": (48, 48), "mosaic": "rggb"}
    write_camera("camera.toml", {"psf": Path("lab/psf.png"), "grey": True, **content})
    without = " ".join(f"--{key.replace('_', '-')} none" for key in content)
    assert run(f"calibrate --camera camera.toml --no-grey {without}")[0] == 0
    assert read_camera("camera.toml").keys() == {"psf", "psf_sha256"}


def test_files_of_a_camera_file_are_known_by_any_path(run, folder):
    """The corrected PSF by its absolute path was corrected again, by the dark frame and without its gain."""
    cv2.imwrite("dark.png", np.full((*SIZE, 3), 2000, np.uint16))
    about = {"psf": Path("lab/psf.png"), "dark": "dark.png", "psf_corrected": True, "dark_exposure": 8.0}
    write_camera("camera.toml", {**about, "psf_gain": ((1.0, 0.1, -0.1),) * 3})
    before = read_camera("camera.toml")
    assert run(f"calibrate {folder}/lab/../lab/psf.png --dark {folder}/dark.png --camera camera.toml")[0] == 0
    assert read_camera("camera.toml") == before


@pytest.mark.usefixtures("folder")
def test_a_bin_of_1_is_kept_because_it_refuses_automatic_binning(run):
    assert run("calibrate lab/psf.png --bin 1 -o refuses.toml")[0] == 0
    assert run("calibrate lab/psf.png -o chooses.toml")[0] == 0
    assert run("calibrate --camera refuses.toml -o again.toml")[0] == 0
    assert [read_camera(f"{name}.toml").get("bin") for name in ("refuses", "again", "chooses")] == [1, 1, None]


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("reconstruct capture.png", "`--psf psf.png`, or its camera file, `--camera camera.toml`"),
        ("inspect", "`--psf psf.png`, or its camera file"),
        ("calibrate", "`--psf psf.png`, or its camera file"),
        ("reconstruct capture.png --camera none.toml", "`none.toml` does not exist"),
        ("calibrate lab/psf.png -o capture.png", "must end in .toml"),
        ("calibrate lab/psf.png --grey --white-balance psf", "needs a PSF in colour"),
        ("reconstruct capture.png --psf lab/psf.png --white-balance 1 -1 1", "`--white-balance`"),
    ],
)
def test_what_is_missing_or_wrong(run, line, message):
    code, _, err = run(line)
    assert code == 2
    assert message in err


@pytest.mark.usefixtures("folder")
def test_camera_file_is_not_overwritten(run, folder):
    assert run("calibrate lab/psf.png")[0] == 0
    (folder / "camera.toml").rename("pairs.h5")
    code, _, err = run("simulate lab --camera pairs.h5 --out pairs.h5")
    assert (code, "would overwrite an input" in err) == (2, True)
