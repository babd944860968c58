"""Find the light of the room in a capture: smooth light on the sensor that has not come from the scene.

The capture b is a scene v through the PSF, and a background B c of even light and a slope:

1. ``b = C H v + B c + noise`` with ``v >= 0`` and ``B c >= 0``. C crops to the sensor.
2. ``r(c) = b - B c - C H v(c)``, where v(c) is the best scene for this background, after `ITERATIONS` of ADMM from a
   dark scene. ``E(c) = |r(c)|^2 / pixels``, in units of the mean measurement.

Scenes can imitate smooth light, by a veil and by light from outside the frame, so E is flat where c has too little of
it. Too much of it cannot be compensated, because light is not negative: beyond the true background E rises steeply.
(`mwdn.solvers.alignment` finds haze in the same way.) So c is searched from above, from the largest plane of light
under the capture, by Gauss-Newton steps that eliminate the scene (variable projection), until E has hardly risen:

3. ``d = argmin |S^-1 d|^2`` such that ``|r + J d|^2 / pixels <= E(0) + (t |J_0|)^2``, then ``c <- c + d``. The finite
   differences ``J = dr / dc`` have a new scene for each c; J_0 is that of the even term at the first step.

A wider choice of backgrounds, with bumps, would take the light of an object in the middle of the frame: one capture
cannot tell them apart. Everything happens in coarse pixels, for each colour by itself.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.errors import checked
from mwdn.fourier.convolution import check_fit
from mwdn.optics.psf import checked_psf
from mwdn.solvers.alignment import halve_psf
from mwdn.solvers.pyramid import halve
from mwdn.solvers.splitting import Penalties, Problem, initial_state, make_filters, update_copies, update_scene
from mwdn.types import Measurement, Psf, Size

PIXELS = 4000
"""The capture is halved until it has at most so many pixels."""

ITERATIONS = 40
"""Of ADMM for each scene. With 20 the best scenes are not reached; with 60 photographs that fill the frame lose twice
as much of their own light."""

STEPS = 3
"""Gauss-Newton steps: an object on dark needs one, a photograph that fills the frame all three."""

TOLERANCE = 0.02
"""The t of equation (3): light by which the background may exceed what fits, as a part of the mean measurement."""

FAINT = 0.08
"""Smaller shares of the light stay in the measurement: as much is found without a room's light in photographs that fill
the frame."""

ABOVE = 0.002
"""Weight of light above the largest plane below a capture; that below it has a weight of 1."""

_PENALTIES = Penalties(0.15, 0.0, 0.6)
_DELTA = -0.05, 0.05, 0.05  # finite differences; less even light, because more is impossible at first
_SPREAD = 1.0, 0.15, 0.15  # S: changes of the even light are taken first


class RoomLight(NamedTuple):
    """Light of the room in captures.

    Args:
        background: (B, C, H, W), not negative, in units of the measurement: subtract it.
        share: (B,), part of each measurement's light, 0 or `FAINT` to 1.
    """

    background: Measurement
    share: Tensor


@checked
@torch.no_grad()
def find_room_light(measurement: Measurement, psf: Psf) -> RoomLight:
    """Find even light and a slope of light in each capture, from the capture alone.

    Args:
        measurement: (B, C, H, W), a tensor as `mwdn.Calibration.correct` returns it.
        psf: (1 or B, 1 or C, h, w), centred. Its scale does not matter.

    Raises:
        ShapeError: batch or channels do not fit.
        PsfError: the PSF is negative, not finite, or dark.

    References:
        G. Golub and V. Pereyra, Separable nonlinear least squares, Inverse Problems 19, R1 (2003); V. Morozov, Methods
        for solving incorrectly posed problems (1984), for the constraint of equation (3).
    """
    check_fit(measurement, psf, "measurement")
    psf, b = checked_psf(psf).float(), measurement.float()
    batch, channels = b.shape[:2]
    size = b.shape[-2], b.shape[-1]
    while b.shape[-2] * b.shape[-1] > PIXELS:
        b, psf = halve(b), halve_psf(psf)
    mean = b.mean((-2, -1), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
    psf = psf.expand(batch, channels, -1, -1).reshape(-1, 1, *psf.shape[-2:])
    c = _search((b / mean).reshape(-1, 1, *b.shape[-2:]), psf / psf.sum((-2, -1), keepdim=True))
    background = _light(c, size).reshape(batch, channels, *size).mul_(mean).clamp_(min=0)
    share = background.mean((1, 2, 3)) / mean.mean((1, 2, 3))
    share = torch.where((share >= FAINT) & (share < 1), share, 0.0)  # NaN is none
    return RoomLight(torch.where(share[:, None, None, None] > 0, background, 0.0).to(measurement.dtype), share)


def _light(c: Tensor, size: Size) -> Tensor:
    """``B c`` (n, 1, H, W) of coefficients (n, 3): even light, and cosines of half a period down and to the right."""
    down, right = (
        math.sqrt(2) * torch.cos((torch.arange(length, device=c.device) + 0.5) * (math.pi / length)) for length in size
    )
    even, rows, columns = c[:, None, None, :].unbind(-1)
    return (even + rows * down[:, None] + columns * right)[:, None]


def _search(b: Measurement, psf: Psf) -> Tensor:
    """Equation (3) for measurements (n, 1, h, w) of mean 1 through PSFs (n, 1, h, w): coefficients (n, 3)."""
    size, count = (b.shape[-2], b.shape[-1]), len(_DELTA) + 1
    delta = b.new_tensor(_DELTA)
    c = _largest_plane(b)
    limit = _residual(b, psf).square().mean(1)
    offsets = torch.cat([delta.new_zeros(1, 3), delta.diag()])
    for step in range(STEPS):
        trials = _light((c[:, None] + offsets).flatten(0, 1), size)
        r = _residual(b.repeat_interleave(count, 0) - trials, psf.repeat_interleave(count, 0)).reshape(
            len(b), count, -1
        )
        J = (r[:, 1:] - r[:, :1]) / delta[:, None]
        if step == 0:
            limit = limit + TOLERANCE**2 * J[:, 0].square().mean(1)
        c = c + _gauss_newton_step(J, r[:, 0], limit)
    return c


def _gauss_newton_step(J: Tensor, r: Tensor, limit: Tensor) -> Tensor:
    """The step d (n, 3) of equation (3) for J (n, 3, pixels) and r (n, pixels); 0 where E is within the limit (n,).

    With ``A = S J^T J S / pixels = U diag(e) U^T``, ``g = U^T S J^T r / pixels`` and the multiplier mu of the
    constraint, ``d = -S U g / (e + mu)``. The linearised E grows with mu: the largest of a logarithmic row of mu that
    keeps the limit is taken, the smallest if none does.
    """
    spread, pixels = r.new_tensor(_SPREAD), r.shape[-1]
    SJ = J * spread[:, None]
    e, U = torch.linalg.eigh(SJ @ SJ.mT / pixels)
    g = (U.mT @ (SJ @ r[..., None]))[..., 0] / pixels
    mu = torch.logspace(-8, 2, 60, device=r.device)[:, None, None]
    d = -g / (e.clamp(min=0) + mu)  # (60, n, 3)
    energy = r.square().mean(1)
    fits = (energy + 2 * (d * g).sum(-1) + (d.square() * e).sum(-1)) <= limit
    largest = (fits.sum(0) - 1).clamp(min=0)
    d = (U @ d[largest, torch.arange(len(r), device=r.device)][..., None])[..., 0]
    return torch.where((energy > limit)[:, None], spread * d, 0.0)


def _largest_plane(b: Measurement) -> Tensor:
    """Coefficients (n, 3) of the largest plane of light below captures (n, 1, h, w), whose noise is smoothed.

    Asymmetric least squares: what is above the plane hardly counts.
    """
    y = F.avg_pool2d(F.pad(b, (1, 1, 1, 1), mode="replicate"), 3, 1).flatten(1)
    X = torch.cat([_light(one[None], (b.shape[-2], b.shape[-1])) for one in torch.eye(3, device=b.device)]).flatten(1)
    weight, c = torch.ones_like(y), y
    for _ in range(15):
        XW = X * weight[:, None]
        c = torch.linalg.solve(XW @ X.mT, XW @ y[..., None])[..., 0]
        weight = torch.where(c @ X < y, ABOVE, 1.0)
    return c


def _residual(b: Measurement, psf: Psf) -> Tensor:
    """Equation (2) of measurements without their background, (n, pixels)."""
    norm = psf.square().sum((-2, -1), keepdim=True).sqrt()  # the penalties are for a PSF of unit norm
    problem = Problem.from_psf(b, psf / norm)
    filters, state = make_filters(problem, _PENALTIES, smooth=False), initial_state(problem, smooth=False)
    for _ in range(ITERATIONS):
        state = update_scene(update_copies(state, problem, _PENALTIES, 0.0, "colour"), problem, filters)
    return (b - state.Hv).flatten(1)
