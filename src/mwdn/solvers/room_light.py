"""Find the light of the room in a capture: smooth light on the sensor that has not come from the scene.

First a narrow spot is found by what no scene explains (`mwdn.solvers.light_spot`), then a plane of light or a wide spot
by the glow that it leaves where most of the scene is dark (`mwdn.solvers.smooth_light`). If the second search finds
nothing, because the PSF is wrong or less of the scene is dark, this module searches a plane by the residual, unless
the caller gives an estimator (`mwdn.inference.room_light`) for captures that are known to have such light. The
capture b is then a scene v through the PSF, and a background B c of even light and a slope:

1. ``b = C H v + B c + noise`` with ``v >= 0`` and ``B c >= 0``. C crops to the sensor. Where b is saturated, the right
   side may be larger.
2. ``r(c) = b - B c - C H v(c)``, where v(c) is the best scene for this background (`mwdn.solvers.unexplained`).
   ``E(c) = |r(c)|^2 / pixels``, in units of the mean measurement.

Scenes can imitate smooth light, by a veil and by light from outside the frame, so E is flat as long as c is too small.
Too large a c cannot be compensated, because light is not negative: beyond the true background E rises steeply.
(`mwdn.solvers.alignment` finds haze in the same way.) So c is searched from above, from the largest plane of light
under the capture, by Gauss-Newton steps that eliminate the scene (variable projection), until E has hardly risen:

3. ``d = argmin |S^-1 d|^2`` such that ``|r + J d|^2 / pixels <= E(0) + (t |J_0|)^2``, then ``c <- c + d``. The finite
   differences ``J = dr / dc`` have a new scene for each c; J_0 is that of the even term at the first step.
4. ``c <- c + B^T r(c) / pixels``, three times, gives back the light that equation (3) tolerates. Here v(c) is the scene
   of the coarsest of `mwdn.solvers.levels.LEVELS`; r is negative where too much has been subtracted.

A richer model of the background would absorb the light of an object in the middle of the frame: with the six cosines up
to a whole period in place of these three planes, photographs that fill the frame lose half of their light, and E is as
small as at the truth. Where the frame is filled, even three planes absorb the scene's own light. Smooth light can be
separated from a scene only where the scene is dark: a plane is subtracted only if it leaves a part of the frame dark
(`DARK_PART`). All steps but this test use coarse pixels, and each colour separately; a spot has the same shape in all
colours, and is fitted again in pixels of half the side.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.errors import checked
from mwdn.fourier.convolution import check_fit
from mwdn.optics.psf import checked_psf, unit_sum
from mwdn.optics.saturation import saturated_pixels, subtract_light
from mwdn.solvers.alignment import halve_psf
from mwdn.solvers.levels import LEVELS
from mwdn.solvers.light_spot import find_spot, refine_spot
from mwdn.solvers.pyramid import MIXED, PsfPyramid, halve
from mwdn.solvers.smooth_light import dark_part, find_smooth_light, fit_below, planes
from mwdn.solvers.unexplained import DELTA, energy, unexplained
from mwdn.types import Measurement, Psf

PIXELS = 4000
"""The capture is halved until it has at most so many pixels."""

STEPS = 3
"""Gauss-Newton steps: an object on dark needs one, a photograph that fills the frame all three."""

TOLERANCE = 0.02
"""The t of equation (3): light by which the background may exceed what fits, as a part of the mean measurement. With
0.01 photographs that fill the frame lose 2 % less of their light, but less is found in real captures; with 0.03 they
lose a tenth more."""

FAINT = 0.08
"""Smaller shares of even and sloping light are not subtracted: as much is found in photographs that fill the frame
without room light."""

DARK_PART = 0.3
"""Least part of the frame that a scene must leave dark, below a quarter of its mean, for even and sloping light to be
subtracted. Without it, photographs that fill the frame lose 2 dB under even light, and through one PSF 3 to 5 dB
without any light of a room. Through three measured PSFs most of them leave less than 0.2 dark, objects on dark at
least 0.32."""

GIVE_BACKS = 3
"""Repetitions of step 4, which gives light back from the plane to the scene. Objects on dark gain 0.2 to 0.8 dB."""

ABOVE = 0.002
"""Weight of pixels above the fitted plane; pixels below it have a weight of 1."""

_SPREAD = 1.0, 0.15, 0.15  # S: changes of the even light are taken first


Estimator = Callable[[Measurement, Psf], Measurement]
"""Light (B, C, h, w) in captures of mean 1 and at most `PIXELS` pixels, through PSFs of sum 1, all of this shape."""


class RoomLight(NamedTuple):
    """Light of the room in captures.

    Args:
        background: (B, C, H, W), not negative, in units of the measurement: subtract it.
        share: (B,), part of each measurement's light, 0 to 1.
    """

    background: Measurement
    share: Tensor


@checked
@torch.no_grad()
def find_room_light(measurement: Measurement, psf: Psf, *, estimate: Estimator | None = None) -> RoomLight:
    """Find even light or a slope, and spots of light, in each capture, from the capture alone.

    Captures of a single row or column have none, nor those with NaN, or with a colour whose mean is negative.

    Args:
        measurement: (B, C, H, W), a tensor as `mwdn.Calibration.correct` returns it.
        psf: (1 or B, 1 or C, h, w), centred. Its scale does not matter.
        estimate: of smooth light where none is found clearly, in place of a plane by the residual; for captures that
            have some (`mwdn.inference.room_light.estimate_room_light`).

    Raises:
        ShapeError: batch or channels do not fit.
        PsfError: the PSF is negative, not finite, or dark.

    References:
        G. Golub and V. Pereyra, Separable nonlinear least squares, Inverse Problems 19, R1 (2003); V. Morozov, Methods
        for solving incorrectly posed problems (1984), for the constraint of equation (3).
    """
    check_fit(measurement, psf, "measurement")
    psf, b = checked_psf(psf).float(), measurement.float()
    # The mean is the unit below. That of darkness less its dark frame may be negative.
    usable = b.isfinite().flatten(1).all(1) & (b.mean((-2, -1)) >= 0).all(1)
    b = torch.where(usable[:, None, None, None], b, 1.0)
    size = b.shape[-2], b.shape[-1]
    if min(size) < 2:  # a slope needs two pixels
        return RoomLight(torch.zeros_like(measurement), b.new_zeros(len(b)))
    mean = b.mean((-2, -1), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
    y, h, saturated = halved(b / mean, psf, PIXELS)
    spot = find_spot(y, h, saturated)
    if spot.amplitude.any():
        spot = refine_spot(*halved(b / mean, psf, 4 * PIXELS), spot)
    narrow = spot.light((y.shape[-2], y.shape[-1]))
    smooth, clear = find_smooth_light(subtract_light(y, narrow), h)
    light = spot.light(size) * mean
    background = light + torch.where(clear[:, None, None, None], smooth.on(size) * mean, 0.0)
    if not clear.all():
        plane = _plane(b, psf, light, mean, (y - narrow, h, saturated), estimate)
        background += torch.where(clear[:, None, None, None], 0.0, plane)
    share = background.mean((1, 2, 3)) / mean.mean((1, 2, 3))
    share = torch.where(usable & (share > 0) & (share < 1), share, 0.0)  # NaN counts as none
    return RoomLight(torch.where(share[:, None, None, None] > 0, background, 0.0).to(measurement.dtype), share)


def _plane(
    b: Measurement,
    psf: Psf,
    light: Tensor,
    mean: Tensor,
    coarse: tuple[Tensor, Tensor, Tensor],
    estimate: Estimator | None,
) -> Tensor:
    """The plane of light in captures, (B, C, H, W), or what ``estimate`` finds; 0 where it does not count.

    Args:
        b: (B, C, H, W).
        psf: of these captures.
        light: that of the spot, (B, C, H, W).
        mean: of the captures, (B, C, 1, 1).
        coarse: the captures less the spot, over their mean, with PSFs and saturated pixels, all (B, C, h, w).
        estimate: as for `find_room_light`.
    """
    size = b.shape[-2], b.shape[-1]
    if estimate is None:
        c = _search(*(each.reshape(-1, 1, *each.shape[-2:]) for each in coarse))
        plane = (c @ planes(size, c.device).flatten(1)).reshape(b.shape).mul_(mean).clamp_(min=0)
    else:
        plane = F.interpolate(estimate(*coarse[:2]), size, mode="bilinear") * mean
    counts = plane.mean((1, 2, 3)) >= FAINT * mean.mean((1, 2, 3))
    if counts.any():
        coarsest = PsfPyramid.from_psf(psf, size, LEVELS[:1])
        counts &= dark_part(coarsest.solve(subtract_light(b, light + plane)).scene) >= DARK_PART
        if estimate is None and counts.any():
            plane = _give_back(b, light, plane, coarsest)
    return torch.where(counts[:, None, None, None], plane, 0.0)


def halved(y: Measurement, psf: Psf, pixels: int) -> tuple[Tensor, Tensor, Tensor]:
    """Captures of at most so many pixels, a PSF of sum 1 for each, and where they are saturated: all (B, C, h, w)."""
    parts = saturated_pixels(y).float()
    while y.shape[-2] * y.shape[-1] > pixels:
        y, psf, parts = halve(y), halve_psf(psf), halve(parts)
    psf = unit_sum(psf)
    return y, psf.expand(*y.shape[:2], -1, -1), parts > MIXED


def _give_back(b: Measurement, light: Tensor, plane: Tensor, coarsest: PsfPyramid) -> Tensor:
    """The plane (B, C, H, W) after equation (4), beside the spot's light."""
    for _ in range(GIVE_BACKS):
        r = coarsest.solve(subtract_light(b, light + plane)).residual
        B, fine = (planes((each.shape[-2], each.shape[-1]), b.device).flatten(1) for each in (r, plane))
        c = r.flatten(2) @ B.T / B.shape[1]
        plane = (plane + (c @ fine).reshape(plane.shape)).clamp(min=0)
    return plane


def _search(b: Measurement, psf: Psf, saturated: Tensor) -> Tensor:
    """Equation (3) for measurements (n, 1, h, w) of mean 1, ``saturated`` in places, through PSFs: c (n, 3)."""
    size = b.shape[-2], b.shape[-1]
    B = planes(size, b.device)
    delta = b.new_tensor([-DELTA, DELTA, DELTA])  # less even light, because more is impossible at first
    c = _largest_plane(b, B)
    limit = energy(unexplained(b, psf, saturated))
    offsets = torch.cat([delta.new_zeros(1, 3), delta.diag()])
    for step in range(STEPS):
        trials = ((c[:, None] + offsets) @ B.flatten(1)).reshape(-1, len(offsets), *size)
        r = unexplained(b - trials, *(each.expand(-1, len(offsets), -1, -1) for each in (psf, saturated)))
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
    mu = torch.logspace(-8, 2, 60, device=r.device, dtype=r.dtype)[:, None, None]
    d = -g / (e.clamp(min=0) + mu)  # (60, n, 3)
    energy = r.square().mean(1)
    fits = (energy + 2 * (d * g).sum(-1) + (d.square() * e).sum(-1)) <= limit
    largest = (fits.sum(0) - 1).clamp(min=0)
    d = (U @ d[largest, torch.arange(len(r), device=r.device)][..., None])[..., 0]
    return torch.where((energy > limit)[:, None], spread * d, 0.0)


def _largest_plane(b: Measurement, B: Tensor) -> Tensor:
    """Coefficients (n, 3) of the largest plane of light below captures (n, 1, h, w), whose noise is smoothed."""
    y = F.avg_pool2d(F.pad(b, (1, 1, 1, 1), mode="replicate"), 3, 1).flatten(1)
    return fit_below(y, B.flatten(1), above=ABOVE, steps=15)
