"""Light over the aperture, against closed forms."""

import math

import pytest
import torch

from cameras import contour_psf
from mwdn.optics.aperture import displaced_envelope, low_order_field, scattered


def number(value):
    return torch.full((1, 1, 1, 1), float(value))


def test_envelope_moves_and_the_pattern_stays(generator):
    """A fine random pattern under a Gaussian of 30 pixels. Guards the direction, and against moving the whole PSF."""
    n, sigma, shift = 128, 30.0, (6.0, -3.0)
    y, x = torch.arange(float(n))[:, None] - n // 2, torch.arange(float(n)) - n // 2

    def envelope(down, right):
        return torch.exp(-0.5 * ((y - down).square() + (x - right).square()) / sigma**2)

    pattern = 0.5 + torch.rand(1, 1, n, n, generator=generator)
    changed = displaced_envelope(pattern * envelope(0, 0), torch.tensor([shift]))
    bright = envelope(0, 0) > 0.5
    # The factor is up to 1.3; the estimate is 1.03 times as wide as the envelope and noisy by 2 %.
    error = (changed / (pattern * envelope(*shift)) - 1)[..., bright].abs()
    unmoved = (envelope(0, 0) / envelope(*shift) - 1)[bright].abs()
    assert error.max() < 0.08
    assert error.mean() < 0.25 * unmoved.mean()


def test_envelope_that_stays_changes_nothing(generator):
    psf = contour_psf((40, 48), cell=10, generator=generator)
    torch.testing.assert_close(displaced_envelope(psf, torch.zeros(1, 2)), psf, rtol=1e-5, atol=1e-9)


def test_scattered_light_is_a_cauchy_distribution():
    """Of a point: R / (2 pi (r^2 + R^2)^1.5), of which a circle of radius a holds 1 - R / sqrt(a^2 + R^2)."""
    point = torch.zeros(1, 1, 129, 129)
    point[..., 64, 64] = 1
    tails = scattered(point, number(1), number(6))[0, 0]
    distance = torch.arange(0.0, 30.0)  # farther out, light that wraps around the padded frame shows
    expected = 6 / (2 * math.pi * (distance.square() + 36) ** 1.5)
    torch.testing.assert_close(tails[64, 64:94], expected, rtol=0.03, atol=0)
    inner, outer = (1 - 6 / math.hypot(radius, 6) for radius in (64.5, 64.5 * math.sqrt(2)))
    assert inner < tails.sum() < outer
    some = scattered(point, number(0.2), number(6))[0, 0]
    assert some[64, 64] == pytest.approx(0.8 + 0.2 * float(expected[0]), rel=1e-3)
    torch.testing.assert_close(scattered(point, number(0), number(6)), point)


def test_low_order_field_is_a_cosine_without_its_mean():
    coefficients = torch.zeros(2, 2)
    coefficients[0, 0], coefficients[0, 1] = 5.0, -2.0
    field = low_order_field(coefficients, (4, 6))
    expected = -torch.cos(math.pi * (torch.arange(6) + 0.5) / 6)
    torch.testing.assert_close(field, (expected / expected.max()).expand(4, 6))
