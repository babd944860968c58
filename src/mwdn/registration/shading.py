"""Measure the shading of recorded pairs: how the light of the scenes differs from the reconstructions' over the frame.

The lensless camera loses light towards the corners of its field, and the camera that recorded the scenes has a lens and
a white balance of its own. With the reconstruction I_n of a pair, undistorted, its scene T_n, and polynomials P_k over
the frame, minimise over the c of each colour, and over a gain a_n and an offset o_n of each picture,

1. ``E(c) = sum_n sum_p |T_n(p) - a_n S(p) I_n(p) - o_n|^2,  S(p) = exp(sum_k c_k P_k(p))``

by Gauss-Newton steps, a_n and o_n eliminated: variable projection.
"""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.optics.polynomials import coefficient_count, polynomials
from mwdn.registration.distortion import GAUSS_NEWTON_STEPS, without_margin
from mwdn.types import size_of

SQUARE_PX = 8
"""Side of the squares that are averaged first: shading is smooth."""

RIDGE = 0.03
"""Ridge of the normal equations, over the mean of their diagonal: it draws c to 0, and so separates S from a_n. With
0.001 eight real pairs come out within 0.01 dB."""


def measure_shading(pictures: Sequence[Tensor], scenes: Sequence[Tensor], order: int) -> Tensor:
    """Coefficients (C, K) for `mwdn.optics.shading`, of the order whose fit to half of the pairs suits the others best.

    Args:
        pictures: reconstructions in the geometry of the scenes, (C, H, W) each, linear light of any scale.
        scenes: (C, H, W) each, of any scale and offset.
        order: largest order of the polynomials. Coefficients of higher orders than the best are zeros; all are if none
            suits the other half better than no shading.
    """
    pairs = [(_blocks(picture), _blocks(scene)) for picture, scene in zip(pictures, scenes, strict=True)]
    P = _blocks(polynomials(order, size_of(pictures[0])).to(pictures[0].device))
    halves = pairs[::2], pairs[1::2]
    best, least = 0, _unexplained(pairs, P[:0], torch.zeros(len(pictures[0]), 0).to(P))
    for count in (coefficient_count(each) for each in range(order + 1) if halves[1]):
        left = sum(_unexplained(other, P[:count], _fit(half, P[:count])) for half, other in (halves, halves[::-1]))
        if left < least:  # not for NaN
            best, least = count, left
    return F.pad(_fit(pairs, P[:best]), (0, len(P) - best))


def _blocks(picture: Tensor) -> Tensor:
    """Means of squares of a picture (N, H, W) without its margin, (N, squares)."""
    inner = without_margin(picture)
    return F.avg_pool2d(inner.double(), min(SQUARE_PX, *inner.shape[-2:])).flatten(1)


def _fit(pairs: list[tuple[Tensor, Tensor]], P: Tensor) -> Tensor:
    """Gauss-Newton steps on (1) for c, (C, K)."""
    c = torch.zeros(len(pairs[0][0]), len(P)).to(P)
    for _ in range(GAUSS_NEWTON_STEPS):
        A, g = torch.zeros(c.numel(), c.numel()).to(P), torch.zeros(c.numel()).to(P)
        for picture, scene in pairs:
            shaded, residual, gain = _without_gain(picture, scene, P, c)
            own_colour = torch.eye(len(c)).to(P)[:, None, :, None]
            J = (gain * own_colour * shaded[:, None, None] * P[:, None]).flatten(0, 1).flatten(1)  # (C K, C squares)
            J = J - _explained(J, shaded)
            A, g = A + J @ J.T, g + J @ residual
        ridge = RIDGE * A.diagonal().mean().clamp(min=1e-12)
        c = c + torch.linalg.solve(A + ridge * torch.eye(c.numel()).to(A), g - ridge * c.flatten()).view_as(c)
    return c


def _without_gain(picture: Tensor, scene: Tensor, P: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``S I`` (C, squares), the residual of (1) (C squares,) with the best a and o, and a; the scene scaled to 1."""
    shaded = (c @ P).exp() * picture
    target = scene.flatten() / scene.square().mean().sqrt().clamp(min=1e-12)
    deviation = shaded.flatten() - shaded.mean()
    gain = deviation @ target / deviation.square().sum().clamp(min=1e-12)
    return shaded, target - _explained(target[None], shaded)[0], gain


def _explained(rows: Tensor, shaded: Tensor) -> Tensor:
    """The part of rows (N, C squares) that a gain of ``S I`` and an offset explain."""
    mean, deviation = rows.mean(1, keepdim=True), shaded.flatten() - shaded.mean()
    slope = rows @ deviation / deviation.square().sum().clamp(min=1e-12)
    return mean + slope[:, None] * deviation


def _unexplained(pairs: list[tuple[Tensor, Tensor]], P: Tensor, c: Tensor) -> float:
    """E of (1)."""
    return sum(float(_without_gain(*pair, P, c)[1].square().sum()) for pair in pairs)
