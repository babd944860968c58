"""Find a Gaussian spot of light in the part of a capture that no scene explains.

With ``r(a) = b - B a - C H v(a)``, where v(a) is the best scene for the background B a of cosines up to `COSINE_ORDER`,
and ``J = dr / da``, a spot of shape B s and amplitude A changes r by ``A J s``. For each s of a grid of centres and
widths, the best amplitude of a colour is ``A = -(s^T q) / (s^T G s)`` with ``q = J^T r``, ``G = J^T J``. It explains
``(s^T q)^2 / (s^T G s)`` of the energy ``|r|^2``. The spot that explains most in all colours together is taken. Only G
and q are needed for all shapes: thousands of them cost less than one iteration of the solver. (The code keeps J
transposed, one row a cosine.)

A scene can imitate the smoothest part of a spot, so that part is missing from r. It follows from the spot's shape,
because a spot has five numbers, not one for each cosine. Narrow spots are estimated best; a spot as wide as the PSF is
left to `mwdn.solvers.smooth_light`.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.solvers.unexplained import differences, energy, unexplained
from mwdn.types import Measurement, Psf, Size, size_of

COSINE_ORDER = 6.0
"""Highest frequency of the cosines in half periods over the frame's width. A spot with a standard deviation of 0.15 of
the width has 2 % of its amplitude there."""

CENTRES = 17
"""Positions along each axis, from `OUTSIDE` before the frame to as far behind it."""

OUTSIDE = 0.1
SIGMAS = 0.1, 0.12, 0.15, 0.18, 0.22, 0.27, 0.33, 0.4
"""Standard deviations over the frame's width. A wider spot is nearly a plane."""

_STEP = (1 + 2 * OUTSIDE) / (CENTRES - 1), (1 + 2 * OUTSIDE) / (CENTRES - 1), 0.03  # of the grid

SEARCH_STEPS = 5
"""Steps of the search. In each, less of the spot is left in the capture, so J is more exact. Photographs that fill the
frame need all of them."""

EVIDENCE = 2.5
"""A spot is accepted if the unexplained energy falls by this factor. It is more than 10 for spots of 0.1 to 0.2 of the
frame's width through the paper's PSF, and at most 1.6 in 19 real captures and without light; once it was 2.9, where a
bright scene continued beyond the frame on all sides."""

PROMISING = 1.5
"""The search ends after a step if the energy has fallen by less than this factor."""

SLIGHT = 0.028
"""A fainter spot needs a larger factor than `EVIDENCE`: the energy that the spot explains, times the factor, must
exceed the square of this part of the mean measurement. With a wrong PSF the residual looks like a faint spot in the
middle of the scene: in 96 captures of real-like cameras the root of the product is at most 0.024 without a spot, but
for one with 0.037, and 0.033 to 0.22 where one is found."""


class Cosines(NamedTuple):
    """Cosines of whole half periods over a frame, (T, h, w), each of mean square 1."""

    light: Tensor

    @property
    def size(self) -> Size:
        """Height and width of the frame."""
        return size_of(self.light)

    def coefficients(self, light: Tensor) -> Tensor:
        """Coefficients (..., T) of light (..., h, w)."""
        return light.flatten(-2) @ self.light.flatten(1).T / self.light[0].numel()


def cosines(size: Size, device: torch.device, order: float = COSINE_ORDER) -> Cosines:
    """All cosines up to a frequency, in half periods over the width, for a frame of this size."""
    height, width = size
    down, right = (torch.arange(n, device=device) for n in size)
    frequency = ((down[:, None] * (width / height)).square() + right.square()).sqrt()
    orders = (frequency <= order).nonzero()
    rows, columns = _waves(height, orders[:, 0]), _waves(width, orders[:, 1])
    return Cosines(rows[:, :, None] * columns[:, None])


class Spot(NamedTuple):
    """A spot of light in each capture.

    Args:
        shape: (B, 3): centre over height and width, standard deviation over the width.
        amplitude: (B, C), light at the centre.
    """

    shape: Tensor
    amplitude: Tensor

    @classmethod
    def none(cls, b: Measurement) -> "Spot":
        """No spot in captures (B, C, h, w)."""
        return cls(b.new_ones(len(b), 3), b.new_zeros(b.shape[:2]))

    def light(self, size: Size) -> Tensor:
        """The spot on a frame, (B, C, h, w)."""
        return self.amplitude[..., None, None] * gaussians(size, self.shape)[:, None]

    def where(self, condition: Tensor, other: "Spot") -> "Spot":
        """Select this spot where a condition (B,) holds, another spot elsewhere."""
        return Spot(*(torch.where(condition[:, None], *both) for both in zip(self, other, strict=True)))


def find_spot(b: Measurement, psf: Psf, saturated: Tensor) -> Spot:
    """The spot in captures (B, C, h, w) of mean 1, ``saturated`` in places, through PSFs (B, C, h, w).

    Its amplitude is 0 where there is none.
    """
    none = Spot.none(b)
    spot, without, least = _fit(b, psf, saturated, none, promising=PROMISING)
    enough = (without - least) * without > SLIGHT**2 * least
    return spot.where((without > EVIDENCE * least) & enough, none)


def refine_spot(b: Measurement, psf: Psf, saturated: Tensor, spot: Spot) -> Spot:
    """Fit a spot again that was found in the same captures at half of this size.

    The error of spots of 30 % is then 0.5 to 0.8 % of the mean measurement instead of 4.2 to 6.9 % over photographs
    that fill the frame, and 0.2 to 0.5 % instead of 0.8 to 0.9 % over objects on dark
    (``benchmarks/ambient.py --spots``). Captures without a spot are not searched again.
    """
    refined, _, _ = _fit(b, psf, saturated, spot, promising=1.0)
    return refined.where((spot.amplitude > 0).any(1), spot)


def _fit(b: Measurement, psf: Psf, saturated: Tensor, spot: Spot, *, promising: float) -> tuple[Spot, Tensor, Tensor]:
    """Improve a spot up to `SEARCH_STEPS` times; returns the best, and the unexplained energy (B,) before and after."""
    basis = cosines(size_of(b), b.device)
    best, r = spot, unexplained(b - spot.light(basis.size), psf, saturated)
    start = least = energy(r)
    for _ in range(SEARCH_STEPS):
        J = differences(b - spot.light(basis.size), psf, saturated, basis.light)
        spot = best_spot(r - basis.coefficients(spot.light(basis.size)) @ J, J, basis)
        r = unexplained(b - spot.light(basis.size), psf, saturated)
        best, before, least = spot.where(energy(r) < least, best), least, torch.minimum(energy(r), least)
        if not ((start > promising * least) & (before > 1.02 * least)).any():
            break
    return best, start, least


def grid(device: torch.device) -> Tensor:
    """Shapes (N, 3) of all spots that are tried."""
    places = torch.linspace(-OUTSIDE, 1 + OUTSIDE, CENTRES, device=device, dtype=torch.float32)
    return torch.cartesian_prod(places, places, torch.tensor(SIGMAS, device=device, dtype=torch.float32))


def gaussians(size: Size, shapes: Tensor) -> Tensor:
    """Spots (N, h, w) of shapes (N, 3), with a maximum of 1 at their centres."""
    height, width = size
    y, x = (torch.arange(length, device=shapes.device, dtype=torch.float32) + 0.5 for length in size)
    centre_y, centre_x, sigma = (shapes[:, :, None] * shapes.new_tensor([[height], [width], [width]])).unbind(1)
    rows = torch.exp(-0.5 * ((y - centre_y) / sigma).square())
    return rows[:, :, None] * torch.exp(-0.5 * ((x - centre_x) / sigma).square())[:, None]


def best_spot(r: Tensor, J: Tensor, basis: Cosines) -> Spot:
    """The best spot for the residual r (B, C, P) without a spot, and J (B, T, P): the best of the grid, refined."""
    G, q, steps = J @ J.mT, -r @ J.mT, r.new_tensor(_STEP)
    shapes = grid(r.device).expand(len(r), -1, -1)
    shape, amplitude = _best_of(shapes, _grid_coefficients(basis.size, r.device), G, q)
    offsets = torch.cartesian_prod(*r.new_tensor([-1.0, 0.0, 1.0]).expand(3, -1))
    for halving in range(1, 7):
        near = (shape[:, None] + steps * offsets / 2**halving).clamp(min=r.new_tensor([-1.0, -1.0, SIGMAS[0]]))
        s = basis.coefficients(gaussians(basis.size, near.flatten(0, 1)).reshape(*near.shape[:2], *basis.size))
        shape, amplitude = _best_of(near, s, G, q)
    return Spot(shape, amplitude)


@lru_cache(2)
def _grid_coefficients(size: Size, device: torch.device) -> Tensor:
    """Coefficients (1, N, T) of all spots of the grid: as expensive as several iterations of the solver."""
    return cosines(size, device).coefficients(gaussians(size, grid(device)))[None]


def _best_of(shapes: Tensor, s: Tensor, G: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Shape (B, 3) and amplitudes (B, C) of the best of some shapes (B, N, 3).

    Args:
        shapes: to compare.
        s: their coefficients, (1 or B, N, T).
        G: (B, T, T).
        q: minus that of the module's text, (B, C, T).
    """
    against = (q @ s.mT).clamp(min=0)  # light is not negative
    power = ((s @ G) * s).sum(-1).clamp(min=torch.finfo(q.dtype).tiny)
    best, chosen = (against.square().sum(1) / power).argmax(-1), torch.arange(len(q), device=q.device)
    return shapes[chosen, best], against[chosen, :, best] / power[chosen, best][:, None]


def _waves(length: int, orders: Tensor) -> Tensor:
    phase = (torch.arange(length, device=orders.device, dtype=torch.float32) + 0.5) * (math.pi / length)
    amplitude = torch.where(orders > 0, math.sqrt(2), 1.0).to(phase.dtype)
    return torch.cos(orders[:, None] * phase) * amplitude[:, None]
