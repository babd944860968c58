"""Whether the PSF's file is gamma-coded, where the truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration
from mwdn.diagnosis.encoding import as_linear_and_coded, gamma
from mwdn.diagnosis.psf_encoding import psf_gamma
from mwdn.io.images import srgb_encode
from mwdn.optics import Camera

SIDE = 128


def stored(image, *, coded=False):
    numbers = (srgb_encode(image) if coded else image).clamp(0, 1) * 65535
    return numbers[0].movedim(0, -1).round().numpy().astype(np.uint16)


@pytest.fixture(scope="module")
def psf():
    """A PSF with the haze of a real one, its maximum at 0.9."""
    psf = contour_psf((SIDE, SIDE), generator=torch.Generator().manual_seed(5))
    return 0.85 * psf / psf.amax() + 0.03


@pytest.fixture(scope="module")
def light(psf):
    """A coloured scene without a symmetry, seen by the camera, with little noise."""
    generator = torch.Generator().manual_seed(3)
    scene = torch.zeros(1, 1, SIDE, SIDE)
    for _ in range(9):
        top, left = torch.randint(30, 90, (2,), generator=generator).tolist()
        scene[..., top : top + 9, left : left + 12] = torch.rand((), generator=generator)
    light = Camera((psf - 0.03) / (psf - 0.03).sum()).forward(scene)
    return 0.8 * light / light.amax() + 0.001 * torch.randn(light.shape, generator=generator)


@pytest.mark.parametrize("capture", ["linear", "srgb"])
@pytest.mark.parametrize("truth", ["linear", "srgb"])
def test_the_better_psf_and_its_flag_are_named(psf, light, capture, truth):
    """A coded PSF was used as it is, without a word."""
    frame, psf_frame = stored(light, coded=capture == "srgb"), stored(psf, coded=truth == "srgb")
    plain = psf_gamma(frame, Calibration.from_array(psf_frame), capture)
    given = psf_gamma(frame, Calibration.from_array(psf_frame, psf_gamma="srgb"), capture)
    assert plain.value == given.value == truth
    assert (plain.state, given.state) == (("good", "doubt") if truth == "linear" else ("doubt", "good"))
    assert plain.options == ("" if truth == "linear" else "--psf-gamma srgb")


def test_the_flag_gives_the_psf_that_was_compared(psf):
    """Within the difference of sRGB and a power of 2.2."""
    frame = stored(psf, coded=True)
    decoded = Calibration.from_array(frame, psf_gamma=2.2)
    torch.testing.assert_close(as_linear_and_coded(Calibration.from_array(frame))[1], decoded.psf, rtol=2e-2, atol=1e-6)
    torch.testing.assert_close(as_linear_and_coded(decoded)[1], decoded.psf)


def test_a_capture_of_unknown_gamma_cannot_tell_but_a_jpeg_can(psf):
    frame, calibration = np.full((SIDE, SIDE, 1), 30_000, np.uint16), Calibration.from_array(stored(psf))
    assert psf_gamma(frame, calibration, "").state == "unknown"
    assert psf_gamma(frame, calibration, "", for_viewing=True).options == "--psf-gamma srgb"
    coded = replace(calibration, psf_format=replace(calibration.psf_format, psf_gamma="srgb"))
    assert psf_gamma(frame, coded, "", for_viewing=True).state == "good"


def test_both_are_told_at_once(psf, light):
    """A phone's JPEGs: the capture's gamma was judged with a PSF that was taken to be linear."""
    frame, calibration = stored(light, coded=True), Calibration.from_array(stored(psf, coded=True))
    capture = gamma(frame, calibration)
    assert capture.options == "--gamma srgb"
    assert psf_gamma(frame, calibration, capture.value).options == "--psf-gamma srgb"
