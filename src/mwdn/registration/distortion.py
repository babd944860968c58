"""Measure the distortion of recorded pairs: another camera recorded the scenes, with its own lens and position.

With the reconstruction I_n of a pair, its scene T_n, and polynomials P_k over the frame, minimise over c, and over a
gain a_n of each picture,

1. ``E(c) = sum_n sum_p (I_n(p + d(p)) - a_n T_n(p))^2,  d(p) = sum_k c_k P_k(p)``

by Gauss-Newton steps. I and T are detail: square roots of light less their local means, so that shading has no effect.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.optics.distortion import undistort
from mwdn.optics.field import gaussian_blur
from mwdn.optics.polynomials import coefficient_count, polynomial_order, polynomials
from mwdn.types import Image

BLURS = 2.0, 1.0
"""Standard deviations in pixels of the Gaussians that smooth both, one after the other; a displacement of three times
the first is found."""

LOCAL = 1 / 16
"""Side of the square of a local mean, over the frame's shorter side. Coarser structure is mostly shading."""

MARGIN = 1 / 20
"""Rim of the frame that is not compared, over its shorter side: light from outside is not in the scene."""

GAUSS_NEWTON_STEPS = 8
"""Steps of each fit, also in `mwdn.registration.shading`."""

RIDGE = 1e-4
"""Ridge of the normal equations, over the mean of their diagonal."""


class _Detail(NamedTuple):
    """Detail of a pair: the reconstruction with its slopes down and right (1, 3, H, W), and the scene (1, 1, H, W)."""

    seen: Image
    scene: Image


def measure_distortion(pictures: Sequence[Tensor], scenes: Sequence[Tensor], order: int) -> Tensor:
    """Coefficients (2, K) for `mwdn.optics.distortion`; zeros unless each half of the pairs fits the other better.

    Args:
        pictures: reconstructions, (C, H, W) each, linear light of any scale.
        scenes: (C, H, W) each, of any scale.
        order: of the polynomials.
    """
    levels = [[_detail(*pair, blur) for pair in zip(pictures, scenes, strict=True)] for blur in BLURS]
    none = torch.zeros(2, coefficient_count(order), dtype=torch.float64, device=pictures[0].device)
    for part in (0, 1):
        half, other = ([level[first::2] for level in levels] for first in (part, 1 - part))
        is_better = other[-1] and _unexplained(other[-1], _fit(half, none)) < _unexplained(other[-1], none)
        if not is_better:  # nor for NaN
            return none
    return _fit(levels, none)


def _detail(picture: Tensor, scene: Tensor, blur: float) -> _Detail:
    roots = torch.stack([picture.mean(0), scene.mean(0)])[:, None].float().clamp(min=0)
    roots = (roots / roots.mean((2, 3), keepdim=True).clamp(min=1e-12)).sqrt()
    side = 2 * round(LOCAL * min(roots.shape[-2:]) / 2) + 1
    local = F.avg_pool2d(F.pad(roots, (side // 2,) * 4, mode="reflect"), side, 1)
    smooth = gaussian_blur(roots - local, blur).double()
    slopes = torch.gradient(smooth[:1], dim=(-2, -1))
    return _Detail(torch.cat([smooth[:1], *slopes], 1), smooth[1:])


def _fit(levels: list[list[_Detail]], coefficients: Tensor) -> Tensor:
    """Gauss-Newton steps at each blur."""
    for pairs in levels:
        for _ in range(GAUSS_NEWTON_STEPS):
            coefficients = coefficients - _step(pairs, coefficients)
    return coefficients


def _step(pairs: list[_Detail], coefficients: Tensor) -> Tensor:
    """Solution of the normal equations of (1), (2, K)."""
    height, width = pairs[0].scene.shape[-2:]
    order = polynomial_order(coefficients.shape[1]) or 0
    over_frame = without_margin(polynomials(order, (height, width)).to(coefficients)).flatten(1)
    count = coefficients.numel()
    A, g = coefficients.new_zeros(count, count), coefficients.new_zeros(count)
    for pair in pairs:
        T = without_margin(pair.scene[0]).flatten()
        seen, down, right = without_margin(undistort(pair.seen, coefficients)[0]).flatten(1)
        J = torch.cat([down * (height - 1) / 2 * over_frame, right * (width - 1) / 2 * over_frame])
        J, residual = _without(T, J), _without(T, seen[None])[0]
        A, g = A + J @ J.T, g + J @ residual
    ridge = RIDGE * A.diagonal().mean().clamp(min=1e-12) * torch.eye(count).to(A)
    return torch.linalg.solve(A + ridge, g).view_as(coefficients)


def _unexplained(pairs: list[_Detail], coefficients: Tensor) -> float:
    """E of (1) over the energy of the reconstructions."""
    residual = total = 0.0
    for pair in pairs:
        seen = without_margin(undistort(pair.seen, coefficients)[0, :1]).flatten(1)
        residual += float(_without(without_margin(pair.scene[0]).flatten(), seen).square().sum())
        total += float(seen.square().sum())
    return residual / max(total, 1e-12)


def without_margin(pictures: Tensor) -> Tensor:
    """Pictures (N, H, W) without the rim that is not compared."""
    margin = round(MARGIN * min(pictures.shape[-2:]))
    height, width = pictures.shape[-2:]
    return pictures[:, margin : height - margin, margin : width - margin]


def _without(T: Tensor, rows: Tensor) -> Tensor:
    """Rows (N, pixels) less their best multiple of a scene (pixels,): eliminates a_n."""
    return rows - (rows @ T)[:, None] * T / T.square().sum().clamp(min=1e-12)
