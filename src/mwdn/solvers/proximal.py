"""Gradient of a picture, its adjoint, and total variation."""

from typing import Literal

import torch
from torch import Tensor

Gradient = tuple[Tensor, Tensor]
"""Differences down the rows and along the columns."""

Variation = Literal["anisotropic", "isotropic", "colour"]
"""What total variation adds up at each pixel.

- ``anisotropic``: the sizes of both differences.
- ``isotropic``: the length of the gradient; edges of all directions cost the same.
- ``colour``: the length of the gradients of all colours together, so that colours prefer to change at the same
  places and coloured noise costs more than grey detail.
"""


def gradient(v: Tensor) -> Gradient:
    """Periodic forward differences, ``(v[i+1] - v[i], v[j+1] - v[j])``."""
    return v.roll(-1, -2).sub_(v), v.roll(-1, -1).sub_(v)  # in place: fresh memory costs more than the sum


def divergence(u: Gradient) -> Tensor:
    """Adjoint of `gradient` (the negative of what physics calls divergence)."""
    return u[0].roll(1, -2).sub_(u[0]).add_(u[1].roll(1, -1)).sub_(u[1])


def _squared_length(u: Gradient, variation: Variation) -> Tensor:
    if variation == "colour":
        return u[0].square().sum(dim=1, keepdim=True) + u[1].square().sum(dim=1, keepdim=True)
    return u[0].square() + u[1].square()


def total_variation(u: Gradient, variation: Variation) -> Tensor:
    """Total variation of each sample, (B,), from its gradient.

    References:
        L. I. Rudin, S. Osher, E. Fatemi, Physica D 60, 259 (1992); for colours P. Blomgren and T. F. Chan, IEEE
        Trans. Image Process. 7, 304 (1998), here without their root over the colours' totals.
    """
    if variation == "anisotropic":
        return (u[0].abs() + u[1].abs()).sum((1, 2, 3))
    return _squared_length(u, variation).sqrt().sum((1, 2, 3))


def dual_projection(u: Gradient, bound: float | Tensor, variation: Variation) -> Gradient:
    """What the proximal map of ``bound * total_variation`` takes away: each size or length, at most ``bound`` of it.

    A root is taken of the larger of length and bound only, so that a zero gradient, which every first iteration has,
    does not give an infinite derivative.
    """
    # A number is filled in on a GPU, and would else be copied there, for which all before it has to end.
    t = bound if isinstance(bound, Tensor) else torch.full_like(u[0][:1, :1, :1, :1], bound)
    if variation == "anisotropic":
        return u[0].clamp(-t, t), u[1].clamp(-t, t)
    smallest = t.square().clamp(min=torch.finfo(t.dtype).tiny)
    part = t / torch.maximum(_squared_length(u, variation), smallest).sqrt_()
    return u[0] * part, u[1] * part
