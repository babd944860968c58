"""`mwdn inspect` as a user types it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mwdn.calibration import Calibration, FrameFormat, PsfFormat
from mwdn.calibration.camera_file import write_camera
from mwdn.cli.camera import CameraOptions
from mwdn.cli.inspect import load_at_psf_resolution
from mwdn.optics import sample_camera


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    """Current folder with a PSF."""
    monkeypatch.chdir(tmp_path)
    psf = sample_camera(1, (64, 72), family="caustics")
    frame = (0.8 * psf / psf.max() * 65535)[0].movedim(0, -1).numpy().astype(np.uint16)
    assert cv2.imwrite("my psf.png", frame[..., ::-1])


@pytest.fixture
def no_page(monkeypatch):
    """Without the page, which takes a second."""
    monkeypatch.setattr("mwdn.calibration.report_page.write_page", lambda *_: None)


def test_page_json_and_lines(run, tmp_path, monkeypatch):
    """Each finding is one line where there is no terminal. A second time the command replaces its own files."""
    code, shown, problem = run("inspect", "my psf.png", "-o", "out")
    assert (code, problem) == (0, "")
    page = cv2.imread(str(tmp_path / "out" / "my psf.png"))
    assert page is not None
    assert min(page.shape[:2]) > 800
    assert page.std() > 10
    content = json.loads((tmp_path / "out" / "my psf.json").read_text())
    assert content["size"] == [64, 72]
    lines = shown.splitlines()
    assert lines[:-1] == [content["headline"], *(f"{each['weight']:4} {each['text']}" for each in content["verdict"])]
    assert max(map(len, lines)) > 80
    monkeypatch.setattr("mwdn.calibration.report_page.write_page", lambda path, *_: path.write_bytes(b"again"))
    code, shown, _ = run("inspect", "my psf.png", "-o", "out", "--json")
    assert (code, json.loads(shown)) == (0, content)
    assert (tmp_path / "out" / "my psf.png").read_bytes() == b"again"


@pytest.mark.parametrize("dark", [False, True])
def test_no_input_is_overwritten(run, tmp_path, monkeypatch, dark):
    monkeypatch.setattr(CameraOptions, "load", pytest.fail)
    options = ("--dark", "my psf.png") if dark else ()
    psf = tmp_path / "there" / "my psf.tif" if dark else "my psf.png"
    before = (tmp_path / "my psf.png").read_bytes()
    code, _, problem = run("inspect", psf, "-o", tmp_path, *options)
    assert code == 2
    assert "my psf.png` would overwrite an input" in problem
    assert (tmp_path / "my psf.png").read_bytes() == before


@pytest.mark.parametrize("suffix", [".png", ".json"])
def test_files_of_the_user_beside_the_psf_stay(run, tmp_path, suffix):
    (tmp_path / "my psf.png").rename(tmp_path / "psf.tif")
    (tmp_path / f"psf{suffix}").write_text("mine")
    code, _, problem = run("inspect", "psf.tif", "-o", tmp_path)
    assert (code, f"psf{suffix}` was not written by this command" in problem) == (2, True)
    assert (tmp_path / f"psf{suffix}").read_text() == "mine"


def test_folder_that_cannot_be_written_to_is_found_first(run, tmp_path, monkeypatch):
    monkeypatch.setattr("mwdn.cli.inspect.inspect_psf", pytest.fail)
    (tmp_path / "file").write_text("no folder")
    code, _, problem = run("inspect", "my psf.png", "-o", "file")
    assert (code, problem.count("`file` must be a folder that can be written to")) == (2, 1)


@pytest.mark.usefixtures("no_page")
def test_json_alone_with_the_options_of_the_camera(run):
    code, shown, _ = run("inspect", "my psf.png", "--json", "--crop", "32", "36", "--bin", "2")
    assert code == 0
    content = json.loads(shown)
    assert content["file"] == "my psf.png"
    assert len(content["noise_gain"]) == 6
    assert content["size"] == [16, 18]


@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize("named", [False, True])
def test_psf_at_its_own_resolution(run, named):
    """Captures of 32 x 36 raw pixels, whose frames do not fit a PSF that was taken at twice the resolution."""
    cv2.imwrite("dark.png", np.full((32, 36, 3), 9, np.uint16))
    np.save("flat.npy", np.full((32, 36, 1), 1, np.float32))
    files = {"dark": Path("dark.png"), "flat_field": Path("flat.npy")}
    write_camera(
        "camera.toml", {"psf": Path("my psf.png"), "psf_bin": 2, **files} if named else {"psf": Path("my psf.png")}
    )
    frames, psf_format = FrameFormat(crop=(32, 36)), PsfFormat(psf_bin=2)
    camera = Path("camera.toml") if named else None
    options = CameraOptions(Path("my psf.png"), frames, psf_format=psf_format, dark=Path("dark.png"), camera=camera)
    calibration = load_at_psf_resolution(options)
    assert calibration.psf_hash == Calibration.from_file("my psf.png", bin=2).psf_hash
    if named:  # the size of the whole frame is that of the options
        assert run("inspect --camera camera.toml --json")[0] == 0


def test_saturated_psf_is_refused(run):
    frame = torch.full((32, 32), 255, dtype=torch.uint8).numpy()
    assert cv2.imwrite("white.png", frame)
    code, _, problem = run("inspect white.png")
    assert code == 2
    assert "PSF is saturated: 1,024 of 1,024 pixels" in problem


def test_one_psf_at_a_time(run):
    assert run("inspect", "my psf.png", "other.png")[0] == 2
