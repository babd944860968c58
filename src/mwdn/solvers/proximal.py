"""Gradient of an image, its adjoint, and the proximal map of total variation."""

from typing import Literal

import torch
from torch import Tensor

Gradient = tuple[Tensor, Tensor]
"""Differences down the rows and along the columns."""

Variation = Literal["anisotropic", "isotropic", "colour"]
"""Total variation: the sum over all pixels of

- ``anisotropic``: the absolute values of both differences.
- ``isotropic``: the length of the gradient; edges of all directions cost the same.
- ``colour``: the length of the gradients of all colours together. Edges at the same place in all colours cost less, so
  coloured noise is removed before grey detail.

References:
    L. I. Rudin, S. Osher, E. Fatemi, Physica D 60, 259 (1992); for colours P. Blomgren and T. F. Chan, IEEE Trans.
    Image Process. 7, 304 (1998), here without their root over the colours' totals.
"""


def gradient(v: Tensor) -> Gradient:
    """Periodic forward differences, ``(v[i+1] - v[i], v[j+1] - v[j])``."""
    return v.roll(-1, -2).sub_(v), v.roll(-1, -1).sub_(v)  # in place: fresh memory costs more than the sum


def divergence(u: Gradient) -> Tensor:
    """Adjoint of `gradient` (the negative of the divergence of physics)."""
    return u[0].roll(1, -2).sub_(u[0]).add_(u[1].roll(1, -1)).sub_(u[1])


def dual_projection(u: Gradient, bound: float | Tensor, variation: Variation) -> Gradient:
    """Project a gradient onto the dual ball of total variation: each value or length is cut to ``bound``.

    By Moreau's identity ``u - dual_projection(u)`` is the proximal map of ``bound`` times the total variation.

    The root is taken of the larger of length and bound: at a zero gradient, as in every first iteration, the root of
    the length has an infinite derivative.
    """
    # Filled on the device: copying a Python number to a GPU waits for all queued work.
    t = bound if isinstance(bound, Tensor) else torch.full_like(u[0][:1, :1, :1, :1], bound)
    if variation == "anisotropic":
        return u[0].clamp(-t, t), u[1].clamp(-t, t)
    if variation == "isotropic":
        square = u[0].square() + u[1].square()
    else:
        square = u[0].square().sum(dim=1, keepdim=True) + u[1].square().sum(dim=1, keepdim=True)
    smallest = t.square().clamp(min=torch.finfo(t.dtype).tiny)
    factor = t / torch.maximum(square, smallest).sqrt_()
    return u[0] * factor, u[1] * factor
