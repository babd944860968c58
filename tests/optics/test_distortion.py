"""Distortion: where the light of a scene lies in a reconstruction, against closed forms."""

import math

import pytest
import torch

from mwdn.optics.distortion import displacement_px, distort, undistort
from mwdn.optics.polynomials import coefficient_count, polynomial_order, polynomials


def waves(y, x):
    """A smooth picture as a function of the place in pixels."""
    return 2 + torch.sin(y / 8 + 0.3) + torch.cos(x / 11) + 0.5 * torch.sin((x - y) / 14)


def places(height, width):
    return torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")


def test_light_is_looked_up_where_the_polynomials_put_it():
    """Each monomial alone, in pixels by hand: one coefficient displaces by half the frame's side times its value."""
    height, width = 60, 90
    y, x = places(height, width)
    v, u = 2 * y / (height - 1) - 1, 2 * x / (width - 1) - 1
    monomials = [torch.ones_like(v), v, u, v * v, v * u, u * u]
    for k, monomial in enumerate(monomials):
        coefficients = torch.zeros(2, 6, dtype=torch.float64)
        coefficients[0, k], coefficients[1, k] = 0.03, -0.02
        moved = y + 0.03 * monomial * (height - 1) / 2, x - 0.02 * monomial * (width - 1) / 2
        found = undistort(waves(y, x)[None, None], coefficients)
        inner = ..., slice(4, -4), slice(4, -4)
        torch.testing.assert_close(found[0, 0][inner], waves(*moved)[inner], atol=0.02, rtol=0)  # of torch's bicubic


def test_distortion_undoes_what_undistortion_does():
    y, x = places(64, 96)
    scene = waves(y, x)[None, None]
    coefficients = torch.tensor([[0.01, 0.0, 0.01, 0.02, -0.01, 0.01], [0.0, 0.01, -0.01, 0.0, 0.01, -0.02]])
    inner = ..., slice(6, -6), slice(6, -6)
    back = undistort(distort(scene, coefficients), coefficients)
    assert (undistort(scene, coefficients) - scene)[inner].abs().max() > 0.2
    torch.testing.assert_close(back[inner], scene[inner], atol=0.035, rtol=0)  # two of torch's bicubic


def test_no_distortion_changes_nothing_and_a_size_does_not_matter():
    picture = torch.rand(2, 3, 20, 31, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(undistort(picture, torch.zeros(2, 6)), picture, atol=1e-5, rtol=0)
    coefficients = torch.zeros(2, 3)
    coefficients[1, 0] = 2 / 30  # a pixel of 31, two of 61
    torch.testing.assert_close(undistort(picture, coefficients)[..., :-1], picture[..., 1:], atol=1e-5, rtol=0)
    wide = torch.rand(1, 1, 20, 61, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(undistort(wide, coefficients)[..., :-2], wide[..., 2:], atol=1e-5, rtol=0)


def test_the_largest_displacement_is_in_pixels():
    coefficients = torch.zeros(2, 6)
    coefficients[0, 0], coefficients[1, 5] = 0.03, -0.04  # everywhere; at the left and right border
    assert displacement_px(coefficients, (101, 101))[1] == pytest.approx(2.5)
    assert displacement_px(coefficients, (101, 201))[1] == pytest.approx(math.hypot(1.5, 4))
    coefficients[1] = 0
    assert displacement_px(coefficients, (101, 201)) == pytest.approx((1.5, 1.5))


@pytest.mark.parametrize("order", range(6))
def test_coefficients_of_each_order(order):
    assert coefficient_count(order) == math.comb(order + 2, 2) == len(polynomials(order, (2, 3)))
    assert polynomial_order(coefficient_count(order)) == order
    assert polynomial_order(coefficient_count(order) + 1) is None
