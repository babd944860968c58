"""The bin of a PSF that was taken at another resolution than the captures."""

import pytest
import torch
from torch.nn import functional as F

from cameras import contour_psf
from mwdn import Calibration, Camera
from mwdn.calibration import PsfFormat
from mwdn.calibration.frame_operations import bin_pixels, crop_centre
from mwdn.diagnosis.sizes import fitting_size
from mwdn.errors import ShapeError
from mwdn.optics.orientation import turn


@pytest.fixture(scope="module")
def fine():
    """A PSF of 192 x 192 pixels, whose lines are some pixels wide."""
    psf = contour_psf((192, 192), line=2.5, cell=45, generator=torch.Generator().manual_seed(0))
    return psf / psf.sum()


@pytest.fixture(scope="module")
def capture(fine):
    """``capture(psf)``: what a camera with this PSF sees of some squares."""
    generator = torch.Generator().manual_seed(1)

    def take(psf):
        height, width = psf.shape[-2:]
        scene = F.interpolate((torch.rand(1, 1, 12, 12, generator=generator) > 0.7).float(), (height // 2, width // 2))
        scene = F.pad(
            scene, (width // 4, width - width // 2 - width // 4, height // 4, height - height // 2 - height // 4)
        )
        measurement = Camera(psf / psf.sum()).forward(scene)
        return 0.8 * measurement / measurement.amax()

    return take


@pytest.mark.parametrize(
    ("bin", "size", "options"),
    [(2, (96, 96), "--psf-bin 2"), (3, (64, 64), "--psf-bin 3"), (2, (80, 64), "--psf-bin 2 --crop 80 64")],
)
def test_bin_of_the_psf(fine, capture, bin, size, options):
    """The last capture could be of a PSF binned by 3, by its width."""
    measurement = crop_centre(capture(bin_pixels(fine, bin)), size)
    verdict = fitting_size(measurement, Calibration(fine))
    assert (verdict.state, verdict.value, verdict.options) == ("doubt", str(bin), options)


def test_bin_of_the_capture(fine, capture):
    small = bin_pixels(fine, 2)
    verdict = fitting_size(capture(fine), Calibration(small / small.sum()))
    assert (verdict.value, verdict.options) == ("1/2", "--bin 2 --psf-bin 1")


def test_bins_that_were_given_are_factors_of_the_advice(fine, capture):
    """The PSF was read with --psf-bin 2 (from twice the size): half of its size would be --psf-bin 4."""
    small, psf_format = bin_pixels(fine, 2), PsfFormat(psf_bin=2)
    verdict = fitting_size(capture(small), Calibration(fine, psf_format=psf_format))
    assert verdict.options == "--psf-bin 4"
    verdict = fitting_size(capture(fine), Calibration(small / small.sum(), psf_format=psf_format))
    assert verdict.options == "--bin 2 --psf-bin 2"


@pytest.mark.parametrize("stored", [None, "flip-top-bottom"])
def test_capture_of_a_camera_held_upright(fine, capture, stored):
    """The sides are exchanged. The advice is for the PSF's file, which the calibration may have turned already."""
    psf = crop_centre(fine, (192, 144))
    turned = psf if stored is None else turn(psf, stored)
    calibration = Calibration(turned / turned.sum(), psf_format=PsfFormat(psf_orientation=stored))
    verdict = fitting_size(capture(turn(psf, "rotate-90")), calibration)
    assert (verdict.state, verdict.options) == ("doubt", "--psf-orientation rotate-90")


def test_noise_cannot_tell(fine):
    noise = torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(2))
    verdict = fitting_size(noise, Calibration(fine))
    assert (verdict.state, verdict.value, verdict.options) == ("unknown", "", "")


def test_size_and_colours_are_checked_apart(fine):
    grey, colours = Calibration(fine), Calibration(fine.expand(-1, 3, -1, -1))
    frame = torch.rand(64, 64, generator=torch.Generator().manual_seed(3)).numpy()
    assert grey.to_measurement(frame).shape == (1, 1, 64, 64)
    with pytest.raises(ShapeError, match=r"192 x 192.*64 x 64"):
        grey.check_fit(grey.to_measurement(frame))
    with pytest.raises(ShapeError, match="grey"):
        colours.check_fit(torch.rand(1, 1, 192, 192))
