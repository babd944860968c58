"""Polynomials of two variables over a frame of any size."""

import math

import torch
from torch import Tensor

from mwdn.types import Size


def polynomials(order: int, size: Size) -> Tensor:
    """`monomials` at the pixels of a frame, (K, height, width)."""
    return monomials(order, *frame_places(size))


def monomials(order: int, y: Tensor, x: Tensor) -> Tensor:
    """Monomials 1, y, x, y^2, y x, x^2 ... up to a total order, (K, *shape of y and x)."""
    return torch.stack([y ** (total - k) * x**k for total in range(order + 1) for k in range(total + 1)])


def polynomial(coefficients: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Polynomials with rows (N, K) of coefficients of `monomials`, (N, *shape of y and x)."""
    terms = monomials(polynomial_order(coefficients.shape[1]) or 0, y, x)
    return torch.einsum("nk,k...->n...", coefficients.to(terms), terms)


def frame_places(size: Size) -> tuple[Tensor, Tensor]:
    """Rows y and columns x of a frame's pixels from -1 to 1, (height, width) each, float64."""
    y, x = (torch.linspace(-1, 1, length, dtype=torch.float64) for length in size)
    return y[:, None].expand(size), x.expand(size)


def coefficient_count(order: int) -> int:
    """Coefficients of a polynomial of two variables, K."""
    return (order + 1) * (order + 2) // 2


def polynomial_order(count: int) -> int | None:
    """Order of the polynomials with ``count`` coefficients; ``None`` if no order has as many."""
    order = (math.isqrt(8 * count + 1) - 3) // 2
    return order if count and coefficient_count(order) == count else None
