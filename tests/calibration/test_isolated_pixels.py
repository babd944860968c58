"""Hot pixels found in a capture: all that stand out, and none that light can make."""

import pytest
import torch
from torch.nn import functional as F

from cameras import contour_psf
from mwdn import Calibration, convolve
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.isolated_pixels import find_isolated_pixels

SIZE = 96, 128
ELECTRONS = 15_000


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=16, generator=generator)


def captured(scene, psf, generator):
    """A capture with photon noise, its brightest pixel at 0.9 of saturation."""
    light = convolve(scene, psf).clamp(min=0)
    return torch.poisson(0.9 * ELECTRONS * light / light.max(), generator=generator) / ELECTRONS


def extended(channels, generator):
    scene = torch.rand(1, channels, 6, 8, generator=generator)
    return F.interpolate(scene, size=SIZE, mode="nearest")


def heated(capture, generator, count=20):
    """The capture with dark current of 10 to 80 % of saturation in some pixels, and where they are."""
    hot = torch.zeros(SIZE, dtype=torch.bool)
    hot.view(-1)[torch.randperm(hot.numel(), generator=generator)[:count]] = True
    current = 0.1 + 0.7 * torch.rand(capture.shape, generator=generator)
    return capture + hot * current, hot[None, None]


@pytest.mark.parametrize("channels", [1, 3])
def test_all_hot_pixels_are_found_and_replaced(psf, generator, channels):
    capture = captured(extended(channels, generator), psf, generator)
    frame, hot = heated(capture, generator)
    assert (find_isolated_pixels(frame) == hot).all()
    assert not find_isolated_pixels(capture).any()
    corrected = Corrections().of_capture(frame)
    good = ~hot.expand_as(frame)
    assert (corrected[good] == capture[good]).all()
    assert (corrected - capture).abs().max() < 0.1


def test_two_neighbours_are_found(psf, generator):
    capture = captured(extended(1, generator), psf, generator)
    capture[0, 0, 40, 50:52] += 0.5
    assert find_isolated_pixels(capture).nonzero()[:, 2:].tolist() == [[40, 50], [40, 51]]


def test_pixels_of_a_mosaic(psf, generator):
    """Each of the four kinds of pixels has another brightness, so neighbours differ."""
    capture = captured(extended(1, generator), psf, generator)
    capture[..., ::2, ::2] *= 0.5
    frame, hot = heated(capture, generator)
    assert (find_isolated_pixels(frame, cell=2) == hot).all()


@pytest.mark.parametrize("points", [1, 2, 5, 20, 100])
def test_points_of_light_are_no_hot_pixels(psf, generator, points):
    """Such a capture is as sharp as the PSF, which has many isolated pixels."""
    scene = torch.zeros(1, 1, *SIZE)
    scene.view(-1)[torch.randperm(scene.numel(), generator=generator)[:points]] = 1.0
    for electrons in (1e3, 1.5e4, 1e6):
        light = convolve(scene, psf).clamp(min=0)
        capture = torch.poisson(0.9 * electrons * light / light.max(), generator=generator) / electrons
        assert not find_isolated_pixels(capture).any()


@pytest.mark.parametrize(
    "capture",
    [
        torch.zeros(1, 1, 40, 40),
        torch.ones(1, 3, 40, 40),
        torch.full((1, 1, 40, 40), torch.nan),
        torch.ones(1, 1, 1, 1),
        torch.ones(1, 1, 1, 40),
        torch.ones(1, 3, 7, 9),
    ],
)
def test_captures_without_any(capture):
    for cell in (1, 2):
        found = find_isolated_pixels(capture, cell=cell)
        assert found.shape == (1, 1, *capture.shape[-2:])
        assert not found.any()


def test_calibration_corrects_captures_only(psf, generator):
    """The PSF keeps its sharpest pixels, and a camera's own map of hot pixels is the only one used."""
    picture = 0.9 * psf[0, 0] / psf.max()
    picture[:8] = 0
    picture[4, 60] = 0.8
    calibration = Calibration.from_array(picture.numpy(), background=0.0)
    assert calibration.psf[0, 0, 4, 60] > 0
    capture = captured(extended(1, generator), psf, generator)
    frame, hot = heated(capture, generator)
    corrected = calibration.correct(frame[0, 0].clamp(max=1).numpy())
    assert (corrected - capture).abs().max() < 0.1
    mapped = Corrections(defects=torch.zeros_like(hot))
    assert mapped.of_capture(frame) is frame
