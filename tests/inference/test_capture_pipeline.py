"""The steps from a raw frame to a scene and the verdicts on it, in batches and for the preview."""

import gc
import weakref

import pytest
import torch
from PIL import Image

from mwdn import read_frame
from mwdn.calibration import Calibration, PsfFormat
from mwdn.errors import ImageError, ShapeError
from mwdn.inference.capture_pipeline import CapturePipeline, PreparedCapture, PsfFile, refuse_infinite
from mwdn.inference.reconstructor import Reconstructor

SIZE = 32, 40


@pytest.fixture
def capture(captures):
    """File of a capture."""
    return captures[0]


def turned(file, orientation):
    """The same pixels with an EXIF orientation."""
    exif = Image.Exif()
    exif[274] = orientation
    to = file.with_name(f"turned-{orientation}.png")
    Image.open(file).save(to, exif=exif)
    return to


def make(psf, file=None, method="wiener", **options):
    psf_file = PsfFile() if file is None else PsfFile.read(file)
    return CapturePipeline(Reconstructor(method, Calibration(psf, **options), device="cpu"), psf_file)


def test_steps_give_what_the_reconstructor_returns(psf, capture):
    pipeline = make(psf)
    frame = read_frame(capture)
    measurement = pipeline.calibration.to_measurement(frame)
    pipeline.check(measurement)
    prepared = pipeline.prepare(measurement, pose=False)
    assert (prepared.room_light, prepared.pose) == (None, None)
    torch.testing.assert_close(pipeline.solve(prepared), pipeline.reconstruct(measurement), rtol=0, atol=0)


def test_room_light_and_pose_are_found_once_for_the_method_and_the_verdicts(psf, capture):
    reconstruct = Reconstructor("wiener", Calibration(psf), align=True, room_light=True, device="cpu")
    pipeline, measurement = CapturePipeline(reconstruct), reconstruct.calibration.correct(read_frame(capture))
    prepared = pipeline.prepare(measurement, pose=True)
    assert prepared.room_light is not None
    assert prepared.pose is not None
    torch.testing.assert_close(pipeline.solve(prepared), reconstruct(measurement), rtol=0, atol=1e-6)


def test_verdicts_on_a_file_and_on_its_content_are_equal(psf, capture):
    file = turned(capture, 6)
    frame = read_frame(file)
    of_files = make(psf, capture).examine_frame(frame, file)
    of_contents = make(psf, capture.read_bytes()).examine_frame(frame, file.read_bytes())
    assert of_files == of_contents
    assert [verdict.state for verdict in of_files if verdict.topic == "exif"] == ["doubt"]


def test_exif_of_the_psf_needs_its_file_and_no_given_orientation(psf, capture):
    frame, given = read_frame(capture), PsfFormat(psf_orientation="rotate-90")
    for pipeline in (make(psf), make(psf, turned(capture, 6), psf_format=given)):
        assert "exif" not in {verdict.topic for verdict in pipeline.examine_frame(frame, capture)}


def test_a_refused_capture_is_not_kept(psf):
    """The error was kept with its traceback, and with that the capture."""
    pipeline, size = make(psf), (40, 48)
    measurement = torch.rand(1, 3, *size)
    kept = weakref.ref(measurement)
    with pytest.raises(ShapeError, match=f"{size[0]} x {size[1]}"):
        pipeline.check(measurement)
    del measurement
    gc.collect()
    assert kept() is None


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_a_scene_that_is_not_finite_is_refused(wrong):
    prepared = PreparedCapture(torch.full((1, 3, *SIZE), 0.25))
    with pytest.raises(ImageError, match=r"^The reconstruction gave NaN or infinity\..*brightest pixel is 0\.25"):
        refuse_infinite(prepared, torch.full((1, 3, *SIZE), wrong))
