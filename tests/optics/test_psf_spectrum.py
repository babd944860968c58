"""Which frequencies a PSF passes, against closed forms, Monte Carlo, and plain numpy."""

import math

import numpy as np
import pytest
import torch
from scipy.special import k1

from cameras import contour_psf, gaussian_psf
from mwdn.errors import ParameterError
from mwdn.fourier.wiener import wiener
from mwdn.optics import psf_spectrum, sample_camera


def point(size):
    psf = torch.zeros(1, 1, *size)
    psf[..., size[0] // 2, size[1] // 2] = 1
    return psf


def test_ring_means_are_a_plain_sum_over_pixels(generator):
    values, radius = torch.rand(5, 6, generator=generator), 6 * torch.rand(5, 6, generator=generator)
    radius[radius.round() == 2] = 3.0
    counts = torch.randint(1, 3, (5, 6), generator=generator).float()
    for multiplicity in (1.0, counts):
        result = psf_spectrum.ring_means(values, radius, 5, counts=multiplicity)
        expected = [0.0] * 5
        for ring in (0, 1, 3, 4):
            on_ring = (radius >= ring - 0.5) & (radius < ring + 0.5)
            weights = (counts if multiplicity is counts else torch.ones(5, 6))[on_ring].tolist()
            expected[ring] = sum(w * v for w, v in zip(weights, values[on_ring].tolist(), strict=True)) / sum(weights)
        assert result.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("size", [(48, 40), (31, 45), (40, 33)])
@pytest.mark.parametrize("regularisation", [1e-4, 1e-2])
def test_noise_gain_is_what_the_wiener_estimate_does_to_noise(size, regularisation, generator):
    """Monte Carlo: 60 fields of unit noise. Their mean square deviates by about gain * sqrt(2 / (60 n)).

    n is the number of independent values, or bright frequencies, of the filtered noise: a tenth of the pixels at least.
    """
    psf = sample_camera(11, size, family="contours")
    noise = torch.randn(60, 3, *size, generator=generator)
    result = wiener(noise, psf, regularisation, boundary="circular").square().mean((0, 2, 3))
    expected = torch.tensor(psf_spectrum.noise_gain(psf, regularisation))
    tolerance = 5 * math.sqrt(2 / (60 * 0.1 * size[0] * size[1]))
    torch.testing.assert_close(result, expected, rtol=tolerance, atol=0)


def test_noise_gain_of_a_point():
    """|H| = 1 everywhere: 1 / (1 + lambda)^2, and 1 / (1 + lambda) of the detail is kept."""
    assert psf_spectrum.noise_gain(point((9, 12)), 0.25) == pytest.approx((0.64,))
    assert psf_spectrum.detail_kept(point((9, 12)), 0.25) == pytest.approx((0.8,))


def test_noise_gain_against_the_whole_plane_in_numpy():
    psf = contour_psf((30, 27), cell=8, generator=torch.Generator().manual_seed(1))
    H2 = abs(np.fft.fft2(psf[0, 0].double().numpy())) ** 2
    assert psf_spectrum.noise_gain(psf, 1e-3)[0] == pytest.approx((H2 / (H2 + 1e-3) ** 2).mean(), rel=1e-5)
    assert psf_spectrum.detail_kept(psf, 1e-3)[0] == pytest.approx((H2 / (H2 + 1e-3)).mean(), rel=1e-5)


def test_lambda_must_be_positive():
    with pytest.raises(ParameterError, match="regularisation"):
        psf_spectrum.noise_gain(point((8, 8)), 0.0)


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_rings_of_a_gaussian(sigma):
    """|H|^2 = exp(-4 pi^2 sigma^2 f^2); aliasing from beyond 1 - f adds at most 4 % in amplitude at 0.4."""
    frequency, power = psf_spectrum.radial_power(gaussian_psf((128, 128), sigma))
    expected = torch.exp(-4 * math.pi**2 * sigma**2 * frequency.square())
    low = frequency <= 0.4
    torch.testing.assert_close(power[low], expected[low], rtol=0.1, atol=1e-6)


def test_resolution_of_a_gaussian_is_where_it_falls_below_the_noise():
    """Solved on a fine grid from exp(-4 pi^2 sigma^2 f^2) S(f) = noise^2, S = c^2 f^-2 / mean f^-2."""
    size, sigma, noise = 128, 1.5, 0.01
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size)
    square = rows**2 + columns**2
    square[0, 0] = np.inf
    f = np.linspace(0.01, 0.5, 100_000)
    signal = np.exp(-4 * np.pi**2 * sigma**2 * f**2) * psf_spectrum.SCENE_CONTRAST**2 / f**2 / (1 / square).mean()
    expected = f[signal >= noise**2].max()
    assert psf_spectrum.resolved_frequency(gaussian_psf((size, size), sigma), noise) == pytest.approx(
        expected, abs=1.5 / size
    )


def test_a_point_resolves_what_the_noise_lets_through():
    assert psf_spectrum.resolved_frequency(point((64, 64)), 1e-3) == 0.5
    assert psf_spectrum.resolved_frequency(point((64, 64)), 100.0) == 0.0


def test_dark_rings_of_a_disc():
    """A disc of radius r has its first zeros at 3.8317 / (2 pi r) and 7.0156 / (2 pi r)."""
    radius, size = 9.0, 257
    y = torch.linspace(-0.5 * size, 0.5 * size, size * 4 + 1)[:-1] + 0.125
    fine = ((y[:, None].square() + y.square()) <= radius**2).float()[None, None]
    disc = torch.nn.functional.avg_pool2d(fine, 4)
    _, rings = psf_spectrum.spectral_zeros(disc / disc.sum())
    for expected in (3.8317, 7.0156):
        assert min(abs(ring - expected / (2 * math.pi * radius)) for ring in rings) < 1.5 / size


def test_random_mask_has_no_dark_rings_and_a_hundredth_of_weak_frequencies(generator):
    """The power of independent pixels has an exponential distribution: 1 - exp(-0.01) lies below 1/100 of the mean."""
    psf = torch.rand(1, 1, 200, 200, generator=generator)
    part, rings = psf_spectrum.spectral_zeros(psf / psf.sum())
    assert rings == ()
    assert part == pytest.approx(1 - math.exp(-0.01), abs=5 * math.sqrt(0.01 / (200 * 200 * math.pi / 8)))


def test_separable_mask_has_more_weak_frequencies(generator):
    """Its power is a product of two exponentials, below c with probability 1 - 2 sqrt(c) K1(2 sqrt(c))."""
    column, row = torch.randn(300, 1, generator=generator), torch.randn(1, 300, generator=generator)
    part, _ = psf_spectrum.spectral_zeros((column * row)[None, None])
    assert part == pytest.approx(1 - 0.2 * k1(0.2), abs=0.01)


def test_radial_spectrum_of_a_known_spot():
    y, x = torch.arange(80.0)[:, None] - 40, torch.arange(80.0) - 40
    spot = torch.exp(-(y**2 + x**2) / (2 * 1.5**2))[None, None]
    result = psf_spectrum.radial_spectrum(spot / spot.sum(), bins=40)
    expected = torch.exp(-2 * (torch.pi * 1.5 * torch.arange(40) / 80) ** 2)
    torch.testing.assert_close(result[:20], expected[:20], rtol=0.05, atol=1e-3)


@pytest.mark.parametrize("size", [(9, 12), (8, 9), (10, 10)])
def test_spectrum_picture_is_the_shifted_modulus(size, generator):
    psf = torch.rand(1, 1, *size, generator=generator)
    modulus = abs(np.fft.fft2(psf[0, 0].double().numpy()))
    rolled = np.roll(modulus / modulus.max(), (size[0] // 2, (size[1] - 1) // 2), (0, 1))
    expected = (1 + np.log10(rolled.clip(1e-3)) / 3) ** 2.2
    np.testing.assert_allclose(psf_spectrum.modulus_image(psf)[0, 0].numpy(), expected, atol=1e-4)
