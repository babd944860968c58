"""Captures to pictures in files: where they go, what is written, what is left out when it is there."""

import json
import os
import re

import cv2
import numpy as np
import pytest
import torch

from mwdn import Camera, read_frame
from mwdn.calibration import Calibration
from mwdn.darkroom import Darkroom, check_outputs, output_of
from mwdn.data.images import srgb_decode
from mwdn.data.sheets import for_people
from mwdn.errors import ImageError, ParameterError
from mwdn.evaluation.consistency import consistency
from mwdn.networks import build
from mwdn.optics.patterns import contour_psf
from mwdn.reconstruct import Reconstructor
from mwdn.solvers import Wiener

SIZE = 32, 40


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()


@pytest.fixture
def captures(tmp_path, psf, generator):
    """Three of them, 16-bit PNG."""
    (tmp_path / "in").mkdir()
    for number in range(3):
        scene = torch.zeros(1, 3, *SIZE)
        scene[..., 10:20, 12 + 4 * number : 22 + 4 * number] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
        seen = Camera(psf).simulate(scene, generator=generator)[0].movedim(0, -1)
        frame = (seen.clamp(0, 1) * 65535).round().numpy().astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"in/{number}.png"), frame[..., ::-1])
    return [tmp_path / f"in/{number}.png" for number in range(3)]


def darkroom(psf, out, method="wiener", **options):
    calibration = psf if isinstance(psf, Calibration) else Calibration(psf)
    return Darkroom(Reconstructor(method, calibration, device="cpu"), "name", out, **options)


def touch(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return [folder / name for name in names]


# --- Files --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "suffix"), [("png", ".png"), ("png16", ".png"), ("tiff", ".tif"), ("npy", ".npy")])
def test_outputs_have_the_captures_names(tmp_path, form, suffix):
    captures = touch(tmp_path / "in", "a.tif", "b.c.npy")
    out = tmp_path / "out"
    check_outputs(captures, out, form)
    assert [output_of(capture, out, form) for capture in captures] == [out / f"a{suffix}", out / f"b.c{suffix}"]
    assert not out.exists()


def test_two_captures_of_one_name(tmp_path):
    one, two = touch(tmp_path, "a.tif", "a.png")
    message = f"`{two}` and `{one}` would both be written to `{tmp_path / 'out' / 'a.png'}`"
    with pytest.raises(ParameterError, match=re.escape(message)):
        check_outputs([one, two], tmp_path / "out", "png")


def test_capture_called_summary(tmp_path):
    captures = touch(tmp_path, "summary.tif")
    with pytest.raises(ParameterError, match=r"summary\.tif` and the summary picture would both be written"):
        check_outputs(captures, tmp_path / "out", "png")
    check_outputs(captures, tmp_path / "out", "tiff")


@pytest.mark.parametrize("taken", ["a.png", "psf.png", "summary.png"])
def test_no_input_is_overwritten(tmp_path, taken):
    captures = touch(tmp_path, "a.png")
    captures += touch(tmp_path / "other", "psf.tif") if taken == "psf.png" else []
    psf = touch(tmp_path, taken)[0]
    out = tmp_path / "other" / ".."  # another spelling of the same folder
    (tmp_path / "other").mkdir(exist_ok=True)
    captures = captures if taken == "a.png" else [tmp_path / "other" / "x.png", *captures[1:]]
    with pytest.raises(ParameterError, match=rf"{taken}` would overwrite an input\. Choose another folder: `--out`"):
        check_outputs(captures, out, "png", protected=(psf, None))


def test_out_is_a_file(tmp_path):
    file, capture = touch(tmp_path, "out", "a.png")
    with pytest.raises(ParameterError, match=r"`.*out` must be a folder, but is a file"):
        check_outputs([capture], file, "png")


def test_link_in_the_output_folder_to_an_input(tmp_path):
    """It would be followed."""
    captures = touch(tmp_path / "in", "a.png")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.png").symlink_to(captures[0])
    with pytest.raises(ParameterError, match=r"out/a\.png` would overwrite an input"):
        check_outputs(captures, tmp_path / "out", "png")


def test_link_to_an_input_that_is_in_the_output_folder(tmp_path):
    touch(tmp_path / "out", "a.png")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").symlink_to(tmp_path / "out" / "a.png")
    with pytest.raises(ParameterError, match=r"out/a\.png` would overwrite an input"):
        check_outputs([tmp_path / "in" / "a.png"], tmp_path / "out", "png")


# --- What is written ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "suffix"), [("tiff", ".tif"), ("npy", ".npy")])
def test_linear_formats_hold_what_the_reconstructor_returns(tmp_path, form, suffix, captures, psf):
    room = darkroom(psf, tmp_path / "out", form=form)
    jobs = list(room.develop(captures))
    assert [job.number for job in jobs] == [0, 1, 2]
    for job, capture in zip(jobs, captures, strict=True):
        assert (job.capture, job.output) == (capture, tmp_path / "out" / (capture.stem + suffix))
        measurement = room.reconstruct.calibration.correct(read_frame(capture))
        scene = room.reconstruct(measurement)
        found = read_frame(job.output)
        assert found.dtype == np.float32
        assert np.array_equal(found, scene[0].movedim(0, -1).numpy())
        assert job.trust == consistency(measurement, psf, scene)
        assert job.measurement is job.pose is job.scene is job.error is None  # a million jobs may be kept
        beside = json.loads(job.output.with_suffix(".json").read_text())
        assert beside["method"] == "name"
        assert beside["psf_hash"] == room.reconstruct.calibration.psf_hash
        assert beside["explained"] == job.trust.explained
        assert beside["doubtful"] == job.trust.doubtful


@pytest.mark.parametrize(("form", "steps"), [("png", 255), ("png16", 65535)])
def test_png_is_the_same_picture_in_srgb(tmp_path, form, steps, captures, psf):
    room = darkroom(psf, tmp_path, form=form, judge=False)
    (job,) = room.develop(captures[:1])
    scene = room.reconstruct(room.reconstruct.calibration.correct(read_frame(captures[0])))
    stored = read_frame(job.output)
    assert np.iinfo(stored.dtype).max == steps
    light = srgb_decode(torch.from_numpy(stored.astype(np.float32) / steps))
    # Half a step of the code is at most 2.275 / 1.055 ... of it in light: the steepest part is at white.
    torch.testing.assert_close(light, for_people(scene)[0].movedim(0, -1), rtol=0, atol=0.5 * 2.3 / steps + 1e-6)
    assert job.trust is None
    assert set(json.loads((tmp_path / "0.json").read_text())) == {"method", "psf_hash", "origin"}


def test_network_is_given_the_pose_that_the_picture_is_judged_by(tmp_path, captures, psf):
    """It would find the same, at the same price."""
    network = build("wiener-bank", width=2, finest=4)
    pictures = []
    for judge in (True, False):
        room = darkroom(psf, tmp_path / str(judge), network, form="npy", judge=judge)
        (job,) = room.develop(captures[:1])
        pictures.append(torch.from_numpy(read_frame(job.output)))
    torch.testing.assert_close(*pictures, rtol=1e-4, atol=1e-5)


def test_captures_are_read_as_the_calibration_says(tmp_path, psf, captures):
    """Blue first and the last row first in the file: the same picture as from a plain file."""
    frame = read_frame(captures[0])
    np.save(tmp_path / "plain.npy", frame)
    np.save(tmp_path / "twisted.npy", frame[::-1, :, ::-1])
    for name, calibration in (("plain", Calibration(psf)), ("twisted", Calibration(psf, bgr=True, upside_down=True))):
        list(darkroom(calibration, tmp_path / "out", form="tiff").develop([tmp_path / f"{name}.npy"]))
    assert np.array_equal(read_frame(tmp_path / "out/plain.tif"), read_frame(tmp_path / "out/twisted.tif"))


def test_nothing_is_written_of_a_bad_capture_and_the_others_go_on(tmp_path, psf, captures):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    np.save(tmp_path / "small.npy", np.zeros((4, 4, 3), np.uint8))
    files = [captures[0], tmp_path / "bad.png", tmp_path / "small.npy", tmp_path / "none.png", captures[1]]
    jobs = list(darkroom(psf, tmp_path / "out").develop(files))
    assert [job.capture for job in jobs] == files
    assert [job.error is None for job in jobs] == [True, False, False, False, True]
    assert isinstance(jobs[1].error, ImageError)
    assert "`psf` (32 x 40) and the capture (4 x 4)" in str(jobs[2].error)
    assert "does not exist" in str(jobs[3].error)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["0.json", "0.png", "1.json", "1.png"]


def test_disk_that_refuses(tmp_path, psf, captures):
    (tmp_path / "out" / "1.png").mkdir(parents=True)
    jobs = list(darkroom(psf, tmp_path / "out").develop(captures))
    assert [job.error is None for job in jobs] == [True, False, True]
    assert "1.png` cannot be written" in str(jobs[1].error)
    assert not (tmp_path / "out" / "1.json").exists()


def test_work_stops_with_its_user(tmp_path, psf, captures):
    """And leaves whole files behind."""
    jobs = darkroom(psf, tmp_path / "out").develop(captures)
    next(jobs)
    jobs.close()
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert left in (["0.json", "0.png"], ["0.json", "0.png", "1.json", "1.png"])


def test_summary_shows_the_first_twelve_that_are_there(tmp_path, psf, captures):
    room = darkroom(psf, tmp_path / "out")
    room.summarise(captures)
    assert not (tmp_path / "out").exists()
    list(room.develop([captures[0], captures[2]]))
    room.summarise([captures[0], captures[1], captures[2]])
    assert read_frame(tmp_path / "out" / "summary.png").shape[0] == 26 + 2 * 246
    room.summarise(captures[:1] * 20)
    assert read_frame(tmp_path / "out" / "summary.png").shape[0] == 26 + 12 * 246


# --- What is there already ----------------------------------------------------------------------------


def resumed(room_psf, out, captures, *arguments, **options):
    """Names of the captures that were done again."""
    jobs = list(darkroom(room_psf, out, *arguments, resume=True, **options).develop(captures))
    assert all(job.error is None for job in jobs)
    return [job.capture.name for job in jobs if not job.kept]


def test_resumed_work_leaves_out_what_is_there(tmp_path, psf, captures):
    out = tmp_path / "out"
    list(darkroom(psf, out).develop(captures[:2]))
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.iterdir()}
    assert resumed(psf, out, captures) == ["2.png"]
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in before} == before
    assert len(list(darkroom(psf, out).develop(captures))) == 3
    assert out.joinpath("0.png").stat().st_mtime_ns > before[out / "0.png"][1]  # not asked to resume


@pytest.mark.parametrize("lost", ["0.png", "0.json"])
@pytest.mark.parametrize("how", ["gone", "empty"])
def test_half_a_result_is_none(tmp_path, lost, how, psf, captures):
    out = tmp_path / "out"
    list(darkroom(psf, out).develop(captures))
    (out / lost).unlink()
    if how == "empty":
        (out / lost.replace("png", "json")).write_text("[]")
    assert resumed(psf, out, captures) == ["0.png"]


@pytest.mark.parametrize("what", ["capture", "regularisation", "network", "weights", "psf", "bits", "dark", "form"])
def test_result_of_anything_else_is_none(tmp_path, what, psf, captures):
    out, method, camera, form = tmp_path / "out", Wiener(), Calibration(psf), "png"
    if what == "weights":
        torch.manual_seed(1)
        method = build("wiener-bank", width=2, finest=8)
    list(darkroom(camera, out, method, judge=False).develop(captures[:1]))
    assert resumed(camera, out, captures[:1], method, judge=False) == []
    if what == "capture":
        os.utime(captures[0], ns=(0, 0))
    elif what == "regularisation":
        method = Wiener(regularisation=1e-3)
    elif what == "network":
        method = build("wiener")
    elif what == "weights":
        method.decoder.head.weight.data[0, 0] += 1e-3
    elif what == "psf":
        camera = Calibration(psf.flip(-1))
    elif what == "bits":
        camera = Calibration(psf, bit_depth=16)
    elif what == "dark":
        camera = Calibration(psf, dark=torch.zeros(1, 3, *SIZE))
    else:
        form = "png16"
    assert resumed(camera, out, captures[:1], method, judge=False, form=form) == ["0.png"]


def test_old_judgement_never_stands_beside_a_new_picture(tmp_path, psf, captures, monkeypatch):
    """Even if the work stops between the two."""
    out = tmp_path / "out"
    list(darkroom(psf, out).develop(captures[:1]))

    def refuse(path, content):
        raise ImageError("full")

    monkeypatch.setattr("mwdn.darkroom.write_json", refuse)
    (job,) = darkroom(psf, out, Wiener(regularisation=1.0)).develop(captures[:1])
    assert str(job.error) == "full"
    assert [path.name for path in out.iterdir()] == ["0.png"]
