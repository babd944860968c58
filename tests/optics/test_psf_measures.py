"""The shape of a PSF against closed forms and plain numpy."""

import math

import numpy as np
import pytest
import torch
from scipy.signal import correlate2d

from cameras import contour_psf, gaussian_psf
from mwdn.optics import psf_measures, sample_camera


def test_effective_rank(generator):
    column, row = torch.rand(20, 1, generator=generator), torch.rand(1, 30, generator=generator)
    assert psf_measures.effective_rank((column * row)[None, None]) == pytest.approx(1.0, abs=1e-3)
    assert psf_measures.effective_rank(torch.eye(24)[None, None]) == pytest.approx(24.0, rel=1e-6)
    psf = sample_camera(3, (40, 30))
    values = np.linalg.svd(psf.mean((0, 1)).double().numpy(), compute_uv=False)
    part = values / values.sum()
    assert psf_measures.effective_rank(psf) == pytest.approx(math.exp(-(part * np.log(part)).sum()), rel=1e-3)


@pytest.mark.parametrize("sigma", [1.5, 3.0])
def test_autocorrelation_of_a_spot(sigma):
    """A Gaussian less its blur by h = size / 20: terms of variance 2 s^2, 2 s^2 + h^2 (twice), 2 s^2 + 2 h^2."""
    size = 200
    result = psf_measures.autocorrelation(gaussian_psf((size, size + 1), sigma))
    r, blur = np.linspace(0, 20, 20_001), size / 20
    parts = [(1, 2 * sigma**2), (-2, 2 * sigma**2 + blur**2), (1, 2 * sigma**2 + 2 * blur**2)]
    profile = sum(weight * np.exp(-(r**2) / (2 * v)) / v for weight, v in parts)
    assert result.width == pytest.approx(2 * r[profile < profile[0] / 2][0], rel=0.02)
    # Pixels sample the rings coarsely, and the interpolation between rings is linear: 2 %.
    assert result.image[100, 100] == pytest.approx(1.0, abs=1e-5)
    assert result.image[100, 104] == pytest.approx(profile[4000] / profile[0], abs=1e-3)
    assert result.lobe < 0.05


def test_width_and_coarsest_bin_of_lines_do_not_depend_on_noise(generator):
    """Gaussian lines of standard deviation s are 3.33 s wide in the autocorrelation; a third of the energy is noise."""
    psf = gaussian_psf((330, 330), 6.0)
    noise = (psf.square().sum() / 2 / psf.numel()).sqrt() * torch.randn(psf.shape, generator=generator)
    noisy = (psf + noise - (psf + noise).quantile(0.05)).clamp(min=0)
    widths = [psf_measures.autocorrelation(picture).width for picture in (psf, noisy)]
    assert widths[1] == pytest.approx(widths[0], rel=0.1)
    assert [psf_measures.coarsest_bin(picture) for picture in (psf, noisy)] == [3, 3]
    assert psf_measures.coarsest_bin(psf[..., :200, :]) == 2  # a side of 100 pixels remains


def test_sharp_patterns_are_not_binned(generator):
    white = torch.rand(1, 1, 320, 320, generator=generator)
    assert psf_measures.coarsest_bin(white) == psf_measures.coarsest_bin((white > 0.99).float()) == 1


def test_autocorrelation_finds_where_a_pattern_repeats(generator):
    """Two copies 30 rows and 12 columns apart: at that displacement half of the light overlaps with the other half."""
    spots = (torch.rand(60, 60, generator=generator) < 0.01).float()
    psf = torch.zeros(1, 1, 128, 128)
    psf[..., 20:80, 20:80] += spots
    psf[..., 50:110, 32:92] += spots
    result = psf_measures.autocorrelation(psf / psf.sum())
    assert result.lobe == pytest.approx(0.5, abs=0.12)
    assert result.lobe_at in ((30, 12), (-30, -12))


def test_support_of_a_box():
    """A box of ones, 21 x 41, on a frame of 100 x 120; 1 % at each side is less than a row."""
    psf = torch.zeros(1, 1, 100, 120)
    psf[..., 43:64, 30:71] = 1
    result = psf_measures.support(psf / psf.sum())
    assert (result.height, result.width) == (21, 41)
    assert result.offset == pytest.approx((3, -10))
    assert result.pixels == pytest.approx(21 * 41)
    assert result.border == 0
    assert result.glow == pytest.approx(1, abs=1e-6)  # a box is nothing but glow
    assert result.contrast == 0


def test_glow_and_border_of_lines_on_a_level(generator):
    """Lines that hold 60 % of the light, on a level over the whole frame: the rest is glow, and lights the border."""
    lines = (torch.rand(100, 100, generator=generator) < 0.05).float()
    psf = 0.6 * lines / lines.sum() + 0.4 / 10_000
    result = psf_measures.support(psf[None, None])
    assert result.glow == pytest.approx(0.4, abs=1e-3)
    assert 0.4 < result.border < 1.6
    bright = 0.6 / lines.sum().item() + 0.4e-4
    assert result.contrast == pytest.approx((bright - 0.4e-4) / (bright + 0.4e-4), rel=1e-3)


def test_likeness_is_the_best_correlation_over_all_displacements(generator):
    first, second = torch.rand(2, 1, 1, 13, 16, generator=generator)
    a, b = ((psf[0, 0] - psf.mean()).double().numpy() for psf in (first, second))
    whole_pixels = correlate2d(a, b).max() / np.sqrt((a**2).sum() * (b**2).sum())
    assert whole_pixels <= psf_measures.likeness(first, second) < 1.1 * whole_pixels
    psf = gaussian_psf((40, 40), 2.0, (14, 20))
    assert psf_measures.likeness(psf, psf) == pytest.approx(1, abs=1e-5)
    assert psf_measures.likeness(psf, gaussian_psf((40, 40), 2.0)) == pytest.approx(1, abs=1e-2)


def test_sharpness_of_a_known_spot():
    """A Gaussian of width s has an autocorrelation of width sqrt(2) s; without its mean, on rings, 4 % less."""
    y, x = torch.arange(81.0)[:, None] - 40, torch.arange(91.0) - 45
    spot = torch.exp(-(y**2 + x**2) / (2 * 3.0**2))[None, None]
    assert psf_measures.autocorrelation_width(spot / spot.sum()) == pytest.approx(2.355 * 2**0.5 * 3.0, rel=0.05)


def test_radial_autocorrelation_is_1_at_0(generator):
    assert psf_measures.radial_autocorrelation(contour_psf((90, 100), cell=20, generator=generator))[0] == 1.0
