"""Find the light of the room in a capture: smooth light on the sensor that has not come from the scene.

First a narrow spot is found by what no scene explains (`mwdn.solvers.light_spot`), then a plane of light or a wide spot
by the glow that it leaves where the scene should be dark (`mwdn.solvers.smooth_light`). Photographs that fill the frame
have no such place, so only narrow spots are found there.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import checked
from mwdn.fourier.convolution import check_fit
from mwdn.optics.psf import checked_psf, unit_sum
from mwdn.optics.saturation import saturated_pixels, subtract_light
from mwdn.solvers.alignment import halve_psf
from mwdn.solvers.light_spot import find_spot, refine_spot
from mwdn.solvers.pyramid import MIXED, halve
from mwdn.solvers.smooth_light import find_smooth_light
from mwdn.types import Measurement, Psf

PIXELS = 4000
"""The capture is halved until it has at most so many pixels."""


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
def find_room_light(measurement: Measurement, psf: Psf) -> RoomLight:
    """Find even light or a slope, and spots of light, in each capture, from the capture alone.

    Captures of a single row or column have none, nor those with NaN, or with a colour whose mean is negative.

    Args:
        measurement: (B, C, H, W), a tensor as `mwdn.Calibration.correct` returns it.
        psf: (1 or B, 1 or C, h, w), centred. Its scale does not matter.

    Raises:
        ShapeError: batch or channels do not fit.
        PsfError: the PSF is negative, not finite, or dark.
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
    y, h, saturated = _halved(b / mean, psf, PIXELS)
    spot = find_spot(y, h, saturated)
    if spot.amplitude.any():
        spot = refine_spot(*_halved(b / mean, psf, 4 * PIXELS), spot)
    light, found = find_smooth_light(subtract_light(y, spot.light((y.shape[-2], y.shape[-1]))), h)
    background = (spot.light(size) + torch.where(found[:, None, None, None], light.on(size), 0.0)) * mean
    share = background.mean((1, 2, 3)) / mean.mean((1, 2, 3))
    share = torch.where(usable & (share > 0) & (share < 1), share, 0.0)  # NaN counts as none
    return RoomLight(torch.where(share[:, None, None, None] > 0, background, 0.0).to(measurement.dtype), share)


def _halved(y: Measurement, psf: Psf, pixels: int) -> tuple[Tensor, Tensor, Tensor]:
    """Captures of at most so many pixels, a PSF of sum 1 for each, and where they are saturated: all (B, C, h, w)."""
    parts = saturated_pixels(y).float()
    while y.shape[-2] * y.shape[-1] > pixels:
        y, psf, parts = halve(y), halve_psf(psf), halve(parts)
    psf = unit_sum(psf)
    return y, psf.expand(*y.shape[:2], -1, -1), parts > MIXED
