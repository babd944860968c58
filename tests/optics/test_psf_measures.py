"""Measures of PSFs against closed forms, Monte Carlo, and plain numpy."""

import math

import numpy as np
import pytest
import torch
from scipy.signal import correlate2d
from scipy.special import k1

from cameras import contour_psf
from mwdn.errors import ParameterError
from mwdn.fourier.wiener import wiener
from mwdn.optics import psf_measures, sample_camera


def gaussian(size, sigma, centre=None):
    row, column = centre or (size[0] // 2, size[1] // 2)
    y, x = torch.arange(size[0])[:, None] - row, torch.arange(size[1]) - column
    psf = torch.exp(-0.5 * (y.square() + x.square()) / sigma**2)
    return (psf / psf.sum())[None, None]


def point(size):
    psf = torch.zeros(1, 1, *size)
    psf[..., size[0] // 2, size[1] // 2] = 1
    return psf


def test_ring_means_are_a_plain_sum_over_pixels(generator):
    values, radius = torch.rand(5, 6, generator=generator), 6 * torch.rand(5, 6, generator=generator)
    radius[radius.round() == 2] = 3.0
    counts = torch.randint(1, 3, (5, 6), generator=generator).float()
    for often in (1.0, counts):
        found = psf_measures.ring_means(values, radius, 5, counts=often)
        expected = [0.0] * 5
        for ring in (0, 1, 3, 4):
            here = (radius >= ring - 0.5) & (radius < ring + 0.5)
            weights = (counts if often is counts else torch.ones(5, 6))[here].tolist()
            expected[ring] = sum(w * v for w, v in zip(weights, values[here].tolist(), strict=True)) / sum(weights)
        assert found.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("size", [(48, 40), (31, 45), (40, 33)])
@pytest.mark.parametrize("regularisation", [1e-4, 1e-2])
def test_noise_gain_is_what_the_wiener_estimate_does_to_noise(size, regularisation, generator):
    """Monte Carlo: 60 fields of unit noise. Their mean square deviates by about gain * sqrt(2 / (60 independent ones)).

    The noise that is left has as many independent values as it has bright frequencies: at least a tenth of the pixels.
    """
    psf = sample_camera(11, size, family="contours")
    noise = torch.randn(60, 3, *size, generator=generator)
    found = wiener(noise, psf, regularisation, boundary="circular").square().mean((0, 2, 3))
    expected = torch.tensor(psf_measures.noise_gain(psf, regularisation))
    tolerance = 5 * math.sqrt(2 / (60 * 0.1 * size[0] * size[1]))
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=0)


def test_noise_gain_of_a_point():
    """|H| = 1 everywhere: 1 / (1 + lambda)^2, and 1 / (1 + lambda) of the detail is kept."""
    assert psf_measures.noise_gain(point((9, 12)), 0.25) == pytest.approx((0.64,))
    assert psf_measures.detail_kept(point((9, 12)), 0.25) == pytest.approx((0.8,))


def test_noise_gain_against_the_whole_plane_in_numpy():
    psf = contour_psf((30, 27), cell=8, generator=torch.Generator().manual_seed(1))
    H2 = abs(np.fft.fft2(psf[0, 0].double().numpy())) ** 2
    assert psf_measures.noise_gain(psf, 1e-3)[0] == pytest.approx((H2 / (H2 + 1e-3) ** 2).mean(), rel=1e-5)
    assert psf_measures.detail_kept(psf, 1e-3)[0] == pytest.approx((H2 / (H2 + 1e-3)).mean(), rel=1e-5)


def test_lambda_must_be_positive():
    with pytest.raises(ParameterError, match="regularisation"):
        psf_measures.noise_gain(point((8, 8)), 0.0)


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_rings_of_a_gaussian(sigma):
    """|H|^2 = exp(-4 pi^2 sigma^2 f^2); sampling adds what lies beyond 1 - f, 4 % in amplitude at 0.4 at most."""
    frequency, power = psf_measures.rings(gaussian((128, 128), sigma))
    expected = torch.exp(-4 * math.pi**2 * sigma**2 * frequency.square())
    seen = frequency <= 0.4
    torch.testing.assert_close(power[seen], expected[seen], rtol=0.1, atol=1e-6)


def test_resolution_of_a_gaussian_is_where_it_falls_below_the_noise():
    """Solved on a fine grid from exp(-4 pi^2 sigma^2 f^2) S(f) = noise^2, S = c^2 f^-2 / mean f^-2."""
    size, sigma, noise = 128, 1.5, 0.01
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size)
    square = rows**2 + columns**2
    square[0, 0] = np.inf
    f = np.linspace(0.01, 0.5, 100_000)
    signal = np.exp(-4 * np.pi**2 * sigma**2 * f**2) * psf_measures.CONTRAST**2 / f**2 / (1 / square).mean()
    expected = f[signal >= noise**2].max()
    assert psf_measures.resolved_frequency(gaussian((size, size), sigma), noise) == pytest.approx(
        expected, abs=1.5 / size
    )


def test_a_point_resolves_what_the_noise_lets_through():
    assert psf_measures.resolved_frequency(point((64, 64)), 1e-3) == 0.5
    assert psf_measures.resolved_frequency(point((64, 64)), 100.0) == 0.0


def test_dark_rings_of_a_disc():
    """A disc of radius r has its first zeros at 3.8317 / (2 pi r) and 7.0156 / (2 pi r)."""
    radius, size = 9.0, 257
    y = torch.linspace(-0.5 * size, 0.5 * size, size * 4 + 1)[:-1] + 0.125
    fine = ((y[:, None].square() + y.square()) <= radius**2).float()[None, None]
    disc = torch.nn.functional.avg_pool2d(fine, 4)
    _, rings = psf_measures.zeros(disc / disc.sum())
    for expected in (3.8317, 7.0156):
        assert min(abs(ring - expected / (2 * math.pi * radius)) for ring in rings) < 1.5 / size


def test_random_mask_has_no_dark_rings_and_a_hundredth_of_weak_frequencies(generator):
    """Power of independent pixels is exponential: 1 - exp(-0.01) of it lies below 1/100 of its mean."""
    psf = torch.rand(1, 1, 200, 200, generator=generator)
    part, rings = psf_measures.zeros(psf / psf.sum())
    assert rings == ()
    assert part == pytest.approx(1 - math.exp(-0.01), abs=5 * math.sqrt(0.01 / (200 * 200 * math.pi / 8)))


def test_separable_mask_has_more_weak_frequencies(generator):
    """Its power is a product of two exponentials, below c with probability 1 - 2 sqrt(c) K1(2 sqrt(c))."""
    column, row = torch.randn(300, 1, generator=generator), torch.randn(1, 300, generator=generator)
    part, _ = psf_measures.zeros((column * row)[None, None])
    assert part == pytest.approx(1 - 0.2 * k1(0.2), abs=0.01)


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
    """Of a Gaussian less its blur by h = size / 20: Gaussians of variance 2 s^2, 2 s^2 + h^2 (twice), 2 s^2 + 2 h^2."""
    size = 200
    found = psf_measures.autocorrelation(gaussian((size, size + 1), sigma))
    r, blur = np.linspace(0, 20, 20_001), size / 20
    parts = [(1, 2 * sigma**2), (-2, 2 * sigma**2 + blur**2), (1, 2 * sigma**2 + 2 * blur**2)]
    profile = sum(weight * np.exp(-(r**2) / (2 * v)) / v for weight, v in parts)
    assert found.width == pytest.approx(2 * r[profile < profile[0] / 2][0], rel=0.02)
    # Pixels lie at whole distances: rings are not quite round, and the line between them not quite the curve.
    assert found.image[100, 100] == pytest.approx(1.0, abs=1e-5)
    assert found.image[100, 104] == pytest.approx(profile[4000] / profile[0], abs=1e-3)
    assert found.lobe < 0.05


def test_autocorrelation_finds_where_a_pattern_repeats(generator):
    """Two copies 30 rows and 12 columns apart: half of the light meets the other half."""
    spots = (torch.rand(60, 60, generator=generator) < 0.01).float()
    psf = torch.zeros(1, 1, 128, 128)
    psf[..., 20:80, 20:80] += spots
    psf[..., 50:110, 32:92] += spots
    found = psf_measures.autocorrelation(psf / psf.sum())
    assert found.lobe == pytest.approx(0.5, abs=0.12)
    assert found.lobe_at in ((30, 12), (-30, -12))


def test_support_of_a_box():
    """A box of ones, 21 x 41, on a frame of 100 x 120; 1 % at each side is less than a row."""
    psf = torch.zeros(1, 1, 100, 120)
    psf[..., 43:64, 30:71] = 1
    found = psf_measures.support(psf / psf.sum())
    assert (found.height, found.width) == (21, 41)
    assert found.offset == pytest.approx((3, -10))
    assert found.pixels == pytest.approx(21 * 41)
    assert found.border == 0
    assert found.glow == pytest.approx(1, abs=1e-6)  # a box is nothing but glow
    assert found.contrast == 0


def test_glow_and_border_of_lines_on_a_level(generator):
    """Lines that hold 60 % of the light, on a level over the whole frame: the rest is glow, and lights the border."""
    lines = (torch.rand(100, 100, generator=generator) < 0.05).float()
    psf = 0.6 * lines / lines.sum() + 0.4 / 10_000
    found = psf_measures.support(psf[None, None])
    assert found.glow == pytest.approx(0.4, abs=1e-3)
    assert 0.4 < found.border < 1.6
    bright = 0.6 / lines.sum().item() + 0.4e-4
    assert found.contrast == pytest.approx((bright - 0.4e-4) / (bright + 0.4e-4), rel=1e-3)


def test_likeness_is_the_best_correlation_over_all_displacements(generator):
    first, second = torch.rand(2, 1, 1, 13, 16, generator=generator)
    a, b = ((each[0, 0] - each.mean()).double().numpy() for each in (first, second))
    expected = correlate2d(a, b).max() / np.sqrt((a**2).sum() * (b**2).sum())
    assert psf_measures.likeness(first, second) == pytest.approx(expected, rel=1e-5)
    psf = gaussian((40, 40), 2.0, (14, 20))
    assert psf_measures.likeness(psf, psf) == pytest.approx(1, abs=1e-5)
    assert psf_measures.likeness(psf, gaussian((40, 40), 2.0)) == pytest.approx(1, abs=1e-2)


def test_sensitivity_of_a_camera_whose_blur_grows():
    """Gaussians of sigma a and b correlate by 2 a b / (a^2 + b^2), on a frame so large that their means vanish."""
    found = psf_measures.sensitivity(lambda sigma: gaussian((160, 160), sigma), [3.0, 4.0, 6.0], reference=3.0)
    assert found == pytest.approx([1, 24 / 25, 36 / 45], abs=5e-3)
