"""Batches of captures: output names, formats, errors, resuming, several processes."""

import dataclasses
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from contextlib import chdir, contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import torch

from cameras import contour_psf
from made import touch
from mwdn import Camera, read_frame
from mwdn.calibration import Calibration, FrameFormat
from mwdn.cli.app import main
from mwdn.errors import ImageError, ParameterError
from mwdn.evaluation.consistency import consistency
from mwdn.inference.batch import Batch
from mwdn.inference.outputs import check_outputs, output_name
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import to_display
from mwdn.io.images import srgb_decode
from mwdn.networks import build
from mwdn.solvers import Admm, Fista, Wiener

SIZE = 32, 40


def make_batch(psf, out, method="wiener", *, check_consistency=False, **options):
    """Without the check, which takes longer than the rest together."""
    calibration = psf if isinstance(psf, Calibration) else Calibration(psf)
    reconstruct = Reconstructor(method, calibration, device="cpu")
    return Batch(reconstruct, "name", out, check_consistency=check_consistency, **options)


# --- Files --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("format", "suffix"), [("png", ".png"), ("png16", ".png"), ("tiff", ".tif"), ("npy", ".npy")])
def test_outputs_have_the_captures_names(tmp_path, format, suffix):
    captures = touch(tmp_path / "in", "a.tif", "b.c.npy")
    out = tmp_path / "out"
    check_outputs(captures, out, format)
    assert [out / output_name(capture, format) for capture in captures] == [out / f"a{suffix}", out / f"b.c{suffix}"]
    assert not out.exists()


def test_two_captures_of_one_name(tmp_path):
    one, two = touch(tmp_path, "a.tif", "a.png")
    message = f"`{two}` and `{one}` would both be written to `{tmp_path / 'out' / 'a.png'}`"
    with pytest.raises(ParameterError, match=re.escape(message)):
        check_outputs([one, two], tmp_path / "out", "png")


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_capture_called_like_the_map_of_another(tmp_path, order):
    """The map replaced the picture, and without a map the picture was removed as an old one."""
    captures = touch(tmp_path, "a.png", "a.support.tif")
    message = rf"`{re.escape(str(captures[1]))}`.*map of `{re.escape(str(captures[0]))}`.*a\.support\.png`"
    with pytest.raises(ParameterError, match=message):
        check_outputs([captures[number] for number in order], tmp_path / "out", "png")
    check_outputs(captures, tmp_path / "out", "tiff")
    check_outputs(captures[1:], tmp_path / "out", "png")


def test_maps_and_pictures_of_earlier_runs_stay(tmp_path, psf, captures):
    out, other = tmp_path / "out", tmp_path / "in" / "0.support.png"
    captures[1].rename(other)
    for first, second, what in ((captures[0], other, "support map"), (other, captures[0], "picture")):
        list(make_batch(psf, out, check_consistency=True, map=True).run([first]))
        with pytest.raises(ParameterError, match=rf"0\.support\.png` is the {what} of another capture"):
            check_outputs([second], out, "png")
        check_outputs([first], out, "png")  # again
        shutil.rmtree(out)


def test_capture_called_summary(tmp_path):
    captures = touch(tmp_path, "summary.tif")
    with pytest.raises(ParameterError, match=r"summary\.tif` has the name of the summary picture, `summary\.png`"):
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
    with pytest.raises(ParameterError, match=rf"{taken}` would overwrite an input\. Choose another folder: `out`"):
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


def test_link_in_the_output_folder_to_another_file(tmp_path):
    """A capture in another folder, say, which was not named."""
    captures, (other,) = touch(tmp_path / "in", "a.png"), touch(tmp_path / "elsewhere", "b.png")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.json").symlink_to(other)
    with pytest.raises(ParameterError, match=r"out/a\.json` is a link to `.*b\.png`"):
        check_outputs(captures, tmp_path / "out", "png")


def test_link_to_an_input_that_is_in_the_output_folder(tmp_path):
    touch(tmp_path / "out", "a.png")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").symlink_to(tmp_path / "out" / "a.png")
    with pytest.raises(ParameterError, match=r"out/a\.png` would overwrite an input"):
        check_outputs([tmp_path / "in" / "a.png"], tmp_path / "out", "png")


@pytest.mark.parametrize("content", ['{"label": "cat"}', "[1]", "", "mine"])
def test_json_of_somebody_else_is_not_replaced(tmp_path, content):
    a, b = touch(tmp_path / "in", "a.png", "b.png")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "b.json").write_text(content)
    check_outputs([a], tmp_path / "out", "png")
    with pytest.raises(ParameterError, match=r"`.*out/b\.json`.*: `out`"):
        check_outputs([a, b], tmp_path / "out", "png")
    (tmp_path / "out" / "b.json").write_text('{"origin": "0123456789abcdef"}')
    check_outputs([a, b], tmp_path / "out", "png")


# --- What is written ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("format", "suffix"), [("tiff", ".tif"), ("imagej", ".tif"), ("npy", ".npy")])
def test_linear_formats_hold_what_the_reconstructor_returns(tmp_path, format, suffix, captures, psf):
    batch = make_batch(psf, tmp_path / "out", format=format)
    jobs = list(batch.run(captures))
    assert [job.number for job in jobs] == [0, 1, 2]
    for job, capture in zip(jobs, captures, strict=True):
        assert (job.capture, job.output) == (capture, tmp_path / "out" / (capture.stem + suffix))
        measurement = batch.reconstruct.calibration.correct(read_frame(capture))
        scene = batch.reconstruct(measurement)
        found = read_frame(job.output)
        assert found.dtype == np.float32
        assert np.array_equal(found, scene[0].movedim(0, -1).numpy())
        assert job.trust is job.error is None
        beside = json.loads(job.output.with_suffix(".json").read_text())
        assert beside.keys() == {"method", "psf_hash", "origin", "file", "bin"}
        assert beside["method"] == "name"
        assert beside["psf_hash"] == batch.reconstruct.calibration.psf_hash


def test_the_check_is_in_the_sidecar(tmp_path, captures, psf):
    batch = make_batch(psf, tmp_path, format="npy", check_consistency=True)
    (job,) = batch.run(captures[:1])
    measurement = batch.reconstruct.calibration.correct(read_frame(captures[0]))
    assert job.trust.consistency == consistency(measurement, psf, batch.reconstruct(measurement))
    assert job.error is None
    beside = json.loads((tmp_path / "0.json").read_text())
    assert beside["explained"] == job.trust.consistency.explained
    assert beside["doubtful"] == job.trust.doubtful


def test_the_scale_of_imagej_is_the_pitch_of_the_pixels(tmp_path, captures, psf):
    calibration = Calibration(psf, FrameFormat(bin=2), pitch_um=4.0)
    np.save(tmp_path / "raw.npy", np.kron(read_frame(captures[0]), np.ones((2, 2, 1), np.uint16)))
    for full_size, pitch in ((False, 4.0), (True, 2.0)):
        (job,) = make_batch(calibration, tmp_path, format="imagej", full_size=full_size).run([tmp_path / "raw.npy"])
        assert job.error is None
        with tifffile.TiffFile(job.output) as file:
            assert np.divide(*file.pages[0].tags["XResolution"].value) == pytest.approx(1 / pitch)
            assert file.imagej_metadata["unit"] == "um"


@pytest.mark.parametrize("height", [120, 121, 124])
def test_full_size_pictures_of_frames_upside_down_are_turned_ones(tmp_path, generator, height):
    """They were displaced by up to ``bin`` pixels: a frame is binned before it is turned."""
    psf, scene = contour_psf((height, 130), line=6.0, generator=generator), torch.zeros(1, 1, height, 130)
    scene[..., 40:50, 60:66] = 1
    for name, image in (("psf.npy", psf), ("raw.npy", Camera(psf).forward(scene))):
        np.save(tmp_path / name, (image / image.max())[0, 0].numpy())
    pictures = []
    for upside_down in (False, True):
        calibration = Calibration.from_file(tmp_path / "psf.npy", bin=3, upside_down=upside_down)
        batch = make_batch(calibration, tmp_path / f"{upside_down}", format="npy", full_size=True)
        pictures += [read_frame(job.output)[..., 0] for job in batch.run([tmp_path / "raw.npy"])]
    np.testing.assert_allclose(pictures[1], pictures[0][::-1], atol=0.02 * pictures[0].max())


@pytest.mark.parametrize(("format", "steps"), [("png", 255), ("png16", 65535)])
def test_png_is_the_same_picture_in_srgb(tmp_path, format, steps, captures, psf):
    batch = make_batch(psf, tmp_path, format=format)
    (job,) = batch.run(captures[:1])
    scene = batch.reconstruct(batch.reconstruct.calibration.correct(read_frame(captures[0])))
    stored = read_frame(job.output)
    assert np.iinfo(stored.dtype).max == steps
    light = srgb_decode(torch.from_numpy(stored.astype(np.float32) / steps))
    # Half a step of the code is at most 2.275 / 1.055 ... of it in light: the steepest part is at white.
    torch.testing.assert_close(light, to_display(scene)[0].movedim(0, -1), rtol=0, atol=0.5 * 2.3 / steps + 1e-6)


def test_check_and_network_share_the_pose(tmp_path, captures, psf):
    """It would find the same, at the same price."""
    network = build("wiener-bank", width=2, finest=0)
    pictures = []
    for check in (True, False):
        batch = make_batch(psf, tmp_path / str(check), network, format="npy", check_consistency=check)
        (job,) = batch.run(captures[:1])
        pictures.append(torch.from_numpy(read_frame(job.output)))
    torch.testing.assert_close(*pictures, rtol=1e-4, atol=1e-5)


def test_the_gamma_of_the_psf_is_judged_once_a_run(tmp_path, captures, generator):
    """In each sidecar file, though it takes a second: the first capture that tells is enough."""
    psf = contour_psf((96, 96), generator=generator).expand(1, 3, -1, -1)
    cv2.imwrite(str(tmp_path / "psf.jpg"), np.zeros((8, 8), np.uint8))
    for capture in captures:
        cv2.imwrite(str(capture), np.full((96, 96, 3), 99, np.uint8))
    batch = make_batch(psf, tmp_path / "out", psf_file=tmp_path / "psf.jpg", check_consistency=True)
    options = [[verdict.options for verdict in job.verdicts] for job in batch.run(captures[:2])]
    assert all("--psf-gamma srgb" in each for each in options)


def test_captures_are_read_as_the_calibration_says(tmp_path, psf, captures):
    """Blue first and the last row first in the file: the same picture as from a plain file."""
    frame = read_frame(captures[0])
    np.save(tmp_path / "plain.npy", frame)
    np.save(tmp_path / "twisted.npy", frame[::-1, :, ::-1])
    for name, frames in (("plain", FrameFormat()), ("twisted", FrameFormat(bgr=True, upside_down=True))):
        list(make_batch(Calibration(psf, frames), tmp_path / "out", format="tiff").run([tmp_path / f"{name}.npy"]))
    assert np.array_equal(read_frame(tmp_path / "out/plain.tif"), read_frame(tmp_path / "out/twisted.tif"))


def test_nothing_is_written_of_a_bad_capture_and_the_others_go_on(tmp_path, psf, captures):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    np.save(tmp_path / "small.npy", np.zeros((4, 4, 3), np.uint8))
    files = [captures[0], tmp_path / "bad.png", tmp_path / "small.npy", tmp_path / "none.png", captures[1]]
    jobs = list(make_batch(psf, tmp_path / "out").run(files))
    assert [job.capture for job in jobs] == files
    assert [job.error is None for job in jobs] == [True, False, False, False, True]
    assert isinstance(jobs[1].error, ImageError)
    assert "`psf` (32 x 40) and the capture (4 x 4)" in str(jobs[2].error)
    assert "does not exist" in str(jobs[3].error)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["0.json", "0.png", "1.json", "1.png"]


@pytest.fixture
def bright(tmp_path, captures):
    """Gives the first capture so many times as bright, in a file of its own."""

    def store(factor):
        np.save(tmp_path / "bright.npy", read_frame(captures[0]) / np.float32(65535) * np.float32(factor))
        return tmp_path / "bright.npy"

    return store


@pytest.mark.parametrize(
    "method", [Fista(iterations=30), Admm(iterations=30), "pyramid"], ids=["fista", "admm", "pyramid"]
)
def test_trust_does_not_depend_on_the_brightness(psf, captures, method):
    """Nor do squares of what a camera of many bits counts overflow."""
    reconstruct = Reconstructor(method, Calibration(psf), device="cpu")
    measurement = reconstruct.calibration.correct(read_frame(captures[0]))
    plain, large = (consistency(each, psf, reconstruct(each)) for each in (measurement, 1e15 * measurement))
    assert dataclasses.astuple(large) == pytest.approx(dataclasses.astuple(plain), rel=0.01, abs=0.01)


@pytest.mark.parametrize(("check", "format"), [(True, "png"), (False, "npy")])
def test_result_that_is_not_finite_changes_nothing_and_the_others_go_on(tmp_path, psf, captures, bright, check, format):
    limit = 1.1 * read_frame(captures[0]).max() / 65535
    batch = make_batch(psf, tmp_path / "out", lambda b, h: b / (b < limit), format=format, check_consistency=check)
    list(batch.run([bright(1)]))
    before = {path: path.read_bytes() for path in batch.out.iterdir()}
    refused, done = batch.run([bright(1.5), captures[1]])
    assert isinstance(refused.error, ImageError)
    assert re.search(r"infinity\. The capture's brightest pixel is \d", str(refused.error))
    assert done.error is None
    assert {path: path.read_bytes() for path in before} == before


def test_a_capture_without_light_is_no_picture(tmp_path, psf):
    np.save(tmp_path / "black.npy", np.zeros((*SIZE, 3), np.uint16))
    (job,) = make_batch(psf, tmp_path / "out").run([tmp_path / "black.npy"])
    assert str(job.error).startswith("The sensor saw no light")
    assert not (tmp_path / "out").exists()


def test_scene_too_large_to_be_checked(tmp_path, psf, captures):
    (job,) = make_batch(psf, tmp_path / "out", lambda b, h: 1e37 * b, check_consistency=True).run(captures[:1])
    assert str(job.error).startswith("The check of the picture gave NaN or infinity.")
    assert not (tmp_path / "out").exists()


def test_disk_that_refuses(tmp_path, psf, captures):
    (tmp_path / "out" / "1.png").mkdir(parents=True)
    jobs = list(make_batch(psf, tmp_path / "out").run(captures))
    assert [job.error is None for job in jobs] == [True, False, True]
    assert "1.png` cannot be written" in str(jobs[1].error)
    assert not (tmp_path / "out" / "1.json").exists()


def test_work_stops_with_its_user(tmp_path, psf, captures):
    """And leaves whole files behind: of the few captures that were read ahead, not of all."""
    many = [shutil.copy(captures[0], tmp_path / f"{number:02}.png") for number in range(12)]
    jobs = make_batch(psf, tmp_path / "out").run(many)
    next(jobs)
    jobs.close()
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    done = len(left) // 2
    assert 1 <= done < 12
    assert left == [f"{number:02}{suffix}" for number in range(done) for suffix in (".json", ".png")]


def test_a_picture_is_reported_while_the_next_one_is_reconstructed(tmp_path, psf, captures):
    first, reported, reconstructed = threading.Event(), [], []

    def method(measurement, psf):
        reconstructed.append(1)
        assert len(reconstructed) == 1 or first.wait(30)
        return measurement

    def report(job):
        reported.append((job.number, job.output.is_file(), job.error))
        first.set()

    list(make_batch(psf, tmp_path / "out", method).run(captures, report))
    assert reported == [(number, True, None) for number in range(3)]


@pytest.mark.parametrize(("method", "iterations"), [(Admm(iterations=4), 4), ("pyramid", 164), ("universal-small", 0)])
def test_progress_counts_the_iterations_of_solvers(tmp_path, psf, captures, method, iterations):
    done = []
    list(make_batch(psf, tmp_path / "out", method).run(captures[:2], progress=done.append))
    assert done == sorted(done)
    first = [part for part in done if 0 < part < 1]
    assert len(first) == max(0, iterations - 1)
    assert {1.0, 2.0} <= set(done)


def test_summary_shows_the_first_twelve_that_are_there(tmp_path, psf, captures):
    batch = make_batch(psf, tmp_path / "out")
    batch.summarise(captures)
    assert not (tmp_path / "out").exists()
    list(batch.run([captures[0], captures[2]]))
    batch.summarise([captures[0], captures[1], captures[2]])
    assert read_frame(tmp_path / "out" / "summary.png").shape[0] == 26 + 2 * 246
    batch.summarise(captures[:1] * 20)
    assert read_frame(tmp_path / "out" / "summary.png").shape[0] == 26 + 12 * 246


# --- What is there already ----------------------------------------------------------------------------


def resumed(psf, out, captures, *arguments, **options):
    """Names of the captures that were done again."""
    jobs = list(make_batch(psf, out, *arguments, resume=True, **options).run(captures))
    assert all(job.error is None for job in jobs)
    return [job.capture.name for job in jobs if not job.existing]


def test_resumed_work_leaves_out_what_is_there(tmp_path, psf, captures):
    out = tmp_path / "out"
    list(make_batch(psf, out).run(captures[:2]))
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.iterdir()}
    assert resumed(psf, out, captures) == ["2.png"]
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in before} == before
    assert len(list(make_batch(psf, out).run(captures))) == 3
    assert out.joinpath("0.png").stat().st_mtime_ns > before[out / "0.png"][1]  # not asked to resume


def test_resumed_work_checks_what_was_not(tmp_path, psf, captures):
    out = tmp_path / "out"
    list(make_batch(psf, out).run(captures[:1]))
    assert resumed(psf, out, captures[:2], check_consistency=True) == ["0.png", "1.png"]
    assert "explained" in json.loads((out / "0.json").read_text())
    assert resumed(psf, out, captures[:2], check_consistency=True) == []
    assert resumed(psf, out, captures[:2]) == []  # more is there than was asked for


@pytest.mark.parametrize("lost", ["0.png", "0.json"])
@pytest.mark.parametrize("how", ["gone", "empty"])
def test_half_a_result_is_none(tmp_path, lost, how, psf, captures):
    out = tmp_path / "out"
    list(make_batch(psf, out).run(captures))
    (out / lost).unlink()
    if how == "empty":
        (out / lost.replace("png", "json")).write_text("[]")
    assert resumed(psf, out, captures) == ["0.png"]


@pytest.mark.parametrize("what", ["capture", "regularisation", "network", "weights", "psf", "bits", "dark", "format"])
def test_result_of_anything_else_is_none(tmp_path, what, psf, captures):
    out, method, camera, format = tmp_path / "out", Wiener(), Calibration(psf), "png"
    if what == "weights":
        method = build("mwdn", width=2)
    list(make_batch(camera, out, method).run(captures[:1]))
    assert resumed(camera, out, captures[:1], method) == []
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
        camera = Calibration(psf, FrameFormat(bit_depth=16))
    elif what == "dark":
        camera = Calibration(psf, dark=torch.zeros(1, 3, *SIZE))
    else:
        format = "png16"
    assert resumed(camera, out, captures[:1], method, format=format) == ["0.png"]


@pytest.mark.parametrize("refused", ["write_json", "support_picture"])
def test_no_picture_stands_without_its_own_sidecar(tmp_path, psf, captures, monkeypatch, refused):
    """Even if the sidecar or the map cannot be written: the next run would take the picture for something else."""
    out = tmp_path / "out"
    list(make_batch(psf, out).run(captures[:1]))

    def refuse(*_):
        raise ImageError("full")

    monkeypatch.setattr(f"mwdn.inference.batch.{refused}", refuse)
    (job,) = make_batch(psf, out, Wiener(regularisation=1.0), check_consistency=True, map=True).run(captures[:1])
    assert str(job.error) == "full"
    assert not list(out.iterdir())


def test_old_map_never_stands_beside_a_new_picture(tmp_path, psf, captures):
    out = tmp_path / "out"
    list(make_batch(psf, out, check_consistency=True, map=True).run(captures[:1]))
    assert (out / "0.support.png").exists()
    list(make_batch(psf, out, Wiener(regularisation=1.0)).run(captures[:1]))
    assert not (out / "0.support.png").exists()


def test_a_picture_of_another_format_does_not_stay_beside_the_new_sidecar(tmp_path, psf, captures):
    out = tmp_path / "out"
    list(make_batch(psf, out).run(captures[:1]))
    assert (out / "0.png").exists()
    (out / "0.tif").write_bytes(b"of the user")
    list(make_batch(psf, out, format="npy").run(captures[:1]))
    assert sorted(path.name for path in out.iterdir()) == ["0.json", "0.npy", "0.png", "0.tif"]  # of the same method
    list(make_batch(psf, out).run(captures[:1]))
    list(make_batch(psf.flip(-1), out, format="npy").run(captures[:1]))
    assert sorted(path.name for path in out.iterdir()) == ["0.json", "0.npy", "0.tif"]


# --- Several processes --------------------------------------------------------------------------------

COUNT = 6


@pytest.fixture(scope="module")
def shop(tmp_path_factory):
    """Folder with psf.npy and `in`, where there are `COUNT` captures and one that is damaged."""
    folder = tmp_path_factory.mktemp("shop")
    (folder / "in").mkdir()
    generator = torch.Generator().manual_seed(3)
    psf = contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1)
    np.save(folder / "psf.npy", (0.9 * psf / psf.max())[0].movedim(0, -1).numpy())
    for number in range(COUNT):
        scene = torch.zeros(1, 3, *SIZE)
        scene[..., 10:20, 5 + number : 15 + number] = 0.9
        seen = Camera(psf).simulate(scene, generator=generator)
        np.save(folder / f"in/{number:02}.npy", seen[0].movedim(0, -1).numpy())
    (folder / "in" / "damaged.npy").write_bytes(b"\x93NUMPY")
    return folder


LINE = "reconstruct in --psf psf.npy --method admm --iterations 30 --format npy --device cpu"


@contextmanager
def threads(count):
    """As many threads as the other processes have: last digits depend on it."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)


def start(folder, out, *launch):
    """``python`` with the command, or with torchrun and the command."""
    line = f"-m mwdn {LINE} --out {out}"
    here = {"PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
    here |= {"GLOO_SOCKET_IFNAME": "lo"} if sys.platform == "linux" else {}
    options = {"cwd": folder, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # A shell lets what it starts in the background ignore the interrupt, and so would this process.
    options["preexec_fn"] = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen([sys.executable, *launch, *line.split()], env={**os.environ, **here}, **options)


def two(folder, out, restarts=0):
    options = f"-m torch.distributed.run --standalone --nproc-per-node 2 --max-restarts {restarts}"
    return start(folder, out, *options.split())


def told(output):
    """Captures of which the output says that they were done."""
    return re.findall(r"^(\d\d\.npy): the picture", output, re.MULTILINE)


def whole(out):
    """Time of writing of each picture that is done, and of what says so."""
    done = [path.with_suffix(".npy") for path in out.glob("??.json")]
    return {path: path.stat().st_mtime_ns for one in done for path in (one, one.with_suffix(".json"))}


@pytest.fixture(scope="module")
def single(shop):
    """What one process writes."""
    shown = StringIO()
    with chdir(shop), threads(1), redirect_stdout(shown), pytest.raises(SystemExit) as ended:
        main([*LINE.split(), "--out", "single"])
    assert ended.value.code == 1  # for the damaged one
    out = shown.getvalue()
    assert told(out) == [f"{number:02}.npy" for number in range(COUNT)]
    assert f"{COUNT} of {COUNT + 1} captures reconstructed into single\n" in out
    return {path.name: path.read_bytes() for path in (shop / "single").iterdir()}


def kill_one(process, out, goal):
    """Kill a worker when so many captures are done; returns its number."""
    while len(list(out.glob("??.json"))) < goal:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.02)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(children) == 2
    os.kill(int(children[1]), signal.SIGKILL)


def assert_finished(out, single):
    """All is there, the same as from one process, and nothing else but what the killed one was writing."""
    found = {path.name: path.read_bytes() for path in out.iterdir() if not path.name.startswith(".mwdn-")}
    assert found == single


linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the children of a process in /proc")


@pytest.mark.acceptance  # as `test_two_machines_share_the_captures`
def test_two_processes_share_the_captures(shop, single):
    process = two(shop, "two")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 1, err
    assert sorted(told(out)) == [f"{number:02}.npy" for number in range(COUNT)]
    assert err.count("damaged.npy` is not") == 1
    assert out.count(f"{COUNT} of {COUNT + 1} captures reconstructed into two\n") == 1
    assert_finished(shop / "two", single)


def machine(folder, out, port, nodes, *, host, restarts=0):
    """One of several, each with a torchrun of its own, which meet at the host's address."""
    options = f"--nnodes {nodes} --nproc-per-node 1 --rdzv-backend c10d --rdzv-id {port} --max-restarts {restarts}"
    where = ["-m", "torch.distributed.run", *options.split(), "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-conf"]
    brief = "last_call_timeout=10,keep_alive_interval=1"  # seconds: 30 and 5 otherwise
    return start(folder, out, *where, f"{brief},is_host={str(host).lower()}")


def listened_to(port):
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.acceptance  # 22 s, most of it two starts of torchrun
def test_two_machines_share_the_captures(shop, single, free_port):
    machines = [machine(shop, "machines", free_port, 2, host=host) for host in (True, False)]
    said = [each.communicate(timeout=300) for each in machines]
    assert [each.returncode for each in machines] == [1, 1], said
    shares = [told(out) for out, _ in said]
    assert all(shares)
    assert sorted(name for share in shares for name in share) == [f"{number:02}.npy" for number in range(COUNT)]
    assert sum(out.count(f"{COUNT} of {COUNT + 1} captures reconstructed into machines\n") for out, _ in said) == 1
    assert sum(err.count("damaged.npy` is not") for _, err in said) == 1
    assert_finished(shop / "machines", single)


@linux
@pytest.mark.acceptance  # 24 s, most of it torchrun's own waiting
def test_a_machine_goes_on_without_another(shop, single, free_port):
    """The one where all meet; the other ends at once, with its process."""
    (shop / "in" / "damaged.npy").rename(shop / "damaged.npy")  # or the status would start all once more
    first = machine(shop, "left", free_port, "1:2", host=True, restarts=1)
    while not listened_to(free_port):  # it joins first, and is process 0
        with pytest.raises(subprocess.TimeoutExpired):
            first.wait(0.02)
    second = machine(shop, "left", free_port, "1:2", host=False, restarts=1)
    while not list((shop / "left").glob("??.json")):
        with pytest.raises(subprocess.TimeoutExpired):
            second.wait(0.02)
    for pid in (*Path(f"/proc/{second.pid}/task/{second.pid}/children").read_text().split(), second.pid):
        os.kill(int(pid), signal.SIGKILL)
    second.communicate(timeout=300)
    _, err = first.communicate(timeout=300)
    (shop / "damaged.npy").rename(shop / "in" / "damaged.npy")
    assert first.returncode == 0, err
    assert "Process 0 of 2 lost the others" in err
    assert_finished(shop / "left", single)


@linux
def test_killed_work_goes_on_where_it_was(shop, single, run, monkeypatch):
    process, folder = start(shop, "killed"), shop / "killed"
    while len(list(folder.glob("??.json"))) < 2:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.02)
    process.send_signal(signal.SIGKILL)
    first, _ = process.communicate(timeout=300)
    assert process.returncode == -signal.SIGKILL
    before = whole(folder)
    monkeypatch.chdir(shop)
    with threads(1):
        _, second, err = run(f"{LINE} --out killed --resume")
    assert f"{COUNT} of {COUNT + 1} captures reconstructed into killed, {len(before) // 2} of them before" in second, (
        err
    )
    # Nothing was done twice: what was there is still as it was, and the rest was done.
    assert {path: path.stat().st_mtime_ns for path in before} == before
    there = {path.name for path in before}
    assert 2 <= len(there) // 2 < COUNT
    assert set(told(first)) <= there
    assert sorted(told(second)) == [
        name for name in sorted(single) if re.match(r"\d\d\.npy", name) and name not in there
    ]
    assert_finished(shop / "killed", single)


@linux
@pytest.mark.acceptance  # SIGKILL above is harder, and `cli/test_interrupt.py` has Ctrl-C
def test_interrupted_work_ends_quietly_and_leaves_whole_files(shop, single):
    process, out = start(shop, "interrupted"), shop / "interrupted"
    while len(list(out.glob("??.json"))) < 2:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "Traceback" not in err
    found = {path.name: path.read_bytes() for path in out.iterdir()}
    assert 4 <= len(found) < len(single)
    assert found == {name: single[name] for name in found}


@linux
@pytest.mark.acceptance  # restarting is torchrun's; resuming after a kill is tested above
def test_torchrun_starts_killed_workers_again(shop, single):
    (shop / "in" / "damaged.npy").rename(shop / "damaged.npy")  # or the status would start them once more
    process = two(shop, "again", restarts=1)
    kill_one(process, shop / "again", goal=2)
    out, err = process.communicate(timeout=300)
    (shop / "damaged.npy").rename(shop / "in" / "damaged.npy")
    assert process.returncode == 0, err
    assert re.search(rf"{COUNT} captures reconstructed into again, \d+ of them before", out)
    assert len(set(told(out))) == len(told(out)) <= COUNT
    assert_finished(shop / "again", single)


def test_the_share_of_room_light_is_in_the_json(captures, psf, tmp_path):
    """As a number, also where there is none; absent if it was not looked for."""
    reconstruct = Reconstructor("wiener", Calibration(psf), device="cpu", room_light=True)
    jobs = list(Batch(reconstruct, "name", tmp_path / "lit", check_consistency=False).run(captures[:1]))
    assert jobs[0].error is None
    content = json.loads(jobs[0].output.with_suffix(".json").read_text())
    assert content["room_light"] == 0.0
    jobs = list(make_batch(psf, tmp_path / "plain").run(captures[:1]))
    assert "room_light" not in json.loads(jobs[0].output.with_suffix(".json").read_text())
