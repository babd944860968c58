"""Mirrored and turned PSFs, named from one simulated capture."""

import pytest
import torch

from cameras import contour_psf
from mwdn.diagnosis.orientation import OrientationFit, fit_orientations
from mwdn.optics.camera import Camera
from mwdn.optics.orientation import turn
from mwdn.solvers.pose import Pose

SIDE = 112
INVERSE = {"rotate-90": "rotate-270", "rotate-270": "rotate-90"}


@pytest.fixture(scope="module")
def capture():
    """A PSF, and a capture of grey rectangles through it with a little noise."""
    generator = torch.Generator().manual_seed(2)
    psf = contour_psf((SIDE, SIDE), cell=14, generator=generator)
    scene = torch.zeros(1, 1, SIDE, SIDE)
    for _ in range(20):
        top, left = torch.randint(20, 76, (2,), generator=generator).tolist()
        scene[..., top : top + 12, left : left + 16] = torch.rand((), generator=generator)
    light = Camera(psf).forward(scene)
    return psf, light + 0.002 * light.amax() * torch.randn(light.shape, generator=generator)


def test_right_psf(capture):
    psf, measurement = capture
    fit = fit_orientations(measurement, psf)
    assert fit.contrast > 1.3
    assert fit.verdict.state == "good"


@pytest.mark.parametrize(
    ("wrong", "remedy"),
    [("flip-left-right", "flip-left-right"), ("rotate-90", "rotate-270"), ("transpose", "transpose")],
)
def test_wrong_orientation_is_named_with_the_turn_that_rights_it(capture, wrong, remedy):
    psf, measurement = capture
    fit = fit_orientations(measurement, turn(psf, wrong), pose=Pose(torch.tensor([0.3]), torch.zeros(1)))
    assert fit.contrast < 1
    assert (fit.verdict.state, fit.verdict.value) == ("doubt", remedy)
    assert fit.verdict.options == f"--psf-orientation {remedy}"


def test_psf_of_another_camera_fits_alike_in_all_orientations(capture):
    other = contour_psf((SIDE, SIDE), cell=14, generator=torch.Generator().manual_seed(9))
    fit = fit_orientations(capture[1], other)
    assert len(fit.misfits) == 8
    assert (fit.verdict.state, fit.verdict.topic) == ("doubt", "another-camera")


def test_noise_cannot_judge_a_psf(capture):
    noise = torch.rand(1, 1, SIDE, SIDE, generator=torch.Generator().manual_seed(3))
    assert fit_orientations(noise, capture[0]).verdict.state == "unknown"


def test_saturated_capture_judges_no_wrong_psf(capture):
    psf, measurement = capture
    clipped = measurement.clamp(max=float(measurement.flatten().quantile(0.7)))
    assert fit_orientations(measurement, psf.flip(-1)).verdict.state == "doubt"
    verdict = fit_orientations(clipped, psf.flip(-1)).verdict
    assert (verdict.state, "30% of the capture's pixels" in verdict.text) == ("unknown", True)


def test_frames_that_are_not_square_have_no_quarter_turns(capture):
    psf, measurement = (image[..., 8:-8, :] for image in capture)
    assert set(fit_orientations(measurement, psf.flip(-1)).misfits) == {
        "",
        "flip-left-right",
        "flip-top-bottom",
        "rotate-180",
    }


def test_small_lead_is_no_verdict():
    misfits = {"": 0.10, "flip-left-right": 0.114, "flip-top-bottom": 0.2, "rotate-180": 0.2}
    assert OrientationFit(misfits, 0.1, 320).verdict.state == "unknown"


def test_advice_replaces_the_turn_that_was_given(capture):
    """Pasted, ``--psf-orientation`` takes the place of the one before: it is the turn of the file as a whole."""
    psf, measurement = capture
    for given, right in (("flip-left-right", "rotate-270"), ("transpose", "none"), ("rotate-90", "flip-top-bottom")):
        file = psf if right == "none" else turn(psf, INVERSE.get(right, right))
        fit = fit_orientations(measurement, turn(file, given), given=given)
        assert fit.verdict.options == f"--psf-orientation {right}"
