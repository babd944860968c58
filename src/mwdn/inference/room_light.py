"""Find the light of the room in a capture: smooth light on the sensor that has not come from the scene.

The capture b is a scene v through the PSF and the light l of the room, ``b = C H v + l + noise`` with ``v >= 0`` and
``l >= 0``. C crops to the sensor. A scene can imitate smooth light, by a glow in its dark part and by light from
outside the frame. So three searches follow each other:

1. a narrow spot, by what no scene explains (`mwdn.solvers.light_spot`);
2. a plane of light or a wide spot, by the glow that it leaves where most of the scene is dark
   (`mwdn.solvers.smooth_light`). It is exact where the PSF is, and finds nothing where the PSF does not fit;
3. where it finds nothing, a network that has learned what scenes, PSFs and their errors look like
   (`mwdn.networks.room_light`).

Smooth light is subtracted only if half of the frame is dark without it (`DARK_PART`). Over a scene that fills the frame
it cannot be distinguished well enough from the scene's own light: the scene absorbs light that is left, but cannot get
back what was subtracted, and 4 % of the light too much costs more than 17 % that is left.
"""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.fourier.convolution import check_fit
from mwdn.networks.room_light import RoomLightUNet, clues
from mwdn.optics.psf import checked_psf, unit_sum
from mwdn.optics.saturation import saturated_pixels, subtract_light
from mwdn.solvers.alignment import halve_psf
from mwdn.solvers.levels import LEVELS
from mwdn.solvers.light_spot import find_spot, refine_spot
from mwdn.solvers.pyramid import MIXED, PsfPyramid, halve
from mwdn.solvers.smooth_light import dark_part, find_smooth_light
from mwdn.types import TINY, Measurement, Psf, size_of
from mwdn.weights.bundled import bundled_file
from mwdn.weights.tensors import fill, read_header, read_tensors

PIXELS = 4000
"""The capture is halved until it has at most so many pixels. A spot is fitted again in four times as many."""

MIN_ROOM_LIGHT = 0.08
"""Smaller shares of light that the network finds are not subtracted. It wrongly finds larger ones in 2 of 54 captures
of real-like cameras without room light, and in 2 of the 384 captures of docs/universal.md, which lose 0.9 dB."""

DARK_PART = 0.5
"""Least part of the frame that a scene must leave dark, below a quarter of its mean. Objects on dark leave 0.55 to 0.8
in captures of real cameras, eight photographs on a display at most 0.36. In one of these the network finds light whose
subtraction costs 1.1 dB."""


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
    # Light is measured in units of the mean, which is negative in some dark captures less their dark frame.
    usable = b.isfinite().flatten(1).all(1) & (b.mean((-2, -1)) >= 0).all(1)
    b = torch.where(usable[:, None, None, None], b, 1.0)
    size = size_of(b)
    if min(size) < 2:  # a slope needs two pixels
        return RoomLight(torch.zeros_like(measurement), b.new_zeros(len(b)))
    mean = b.mean((-2, -1), keepdim=True).clamp(min=TINY)
    y, h, saturated = halved(b / mean, psf, PIXELS)
    spot = find_spot(y, h, saturated)
    if spot.amplitude.any():
        spot = refine_spot(*halved(b / mean, psf, 4 * PIXELS), spot)
    y, spot_light = subtract_light(y, spot.light(size_of(y))), spot.light(size) * mean
    smooth, clear = find_smooth_light(y, h)
    light = smooth.on(size) * mean
    if not clear.all():
        learned = _learned_light(subtract_light(b, spot_light), psf, (y * mean, h))
        light = torch.where(clear[:, None, None, None], light, learned)
    background = spot_light + light
    share = background.mean((1, 2, 3)) / mean.mean((1, 2, 3))
    share = torch.where(usable & (share > 0) & (share < 1), share, 0.0)  # NaN counts as none
    return RoomLight(torch.where(share[:, None, None, None] > 0, background, 0.0).to(measurement.dtype), share)


def halved(y: Measurement, psf: Psf, pixels: int) -> tuple[Tensor, Tensor, Tensor]:
    """Captures of at most so many pixels, a PSF of sum 1 for each, and where they are saturated: all (B, C, h, w)."""
    parts = saturated_pixels(y).float()
    while y.shape[-2] * y.shape[-1] > pixels:
        y, psf, parts = halve(y), halve_psf(psf), halve(parts)
    psf = unit_sum(psf)
    return y, psf.expand(*y.shape[:2], -1, -1), parts > MIXED


def _learned_light(b: Measurement, psf: Psf, coarse: tuple[Tensor, Tensor]) -> Measurement:
    """What the network finds in coarse captures and PSFs, for captures (B, C, H, W); 0 where it does not count."""
    size = size_of(b)
    light = F.interpolate(estimate_room_light(*coarse), size, mode="bilinear")
    counts = light.mean((1, 2, 3)) > MIN_ROOM_LIGHT * b.mean((1, 2, 3))
    if counts.any():
        scene = PsfPyramid.from_psf(psf, size, LEVELS[:1]).solve(subtract_light(b, light)).scene
        counts &= dark_part(scene) >= DARK_PART
    return torch.where(counts[:, None, None, None], light, 0.0)


def estimate_room_light(b: Measurement, psf: Psf) -> Measurement:
    """Smooth light in coarse captures, by the bundled network.

    Args:
        b: (B, C, h, w), of at most `PIXELS` pixels.
        psf: (B, C, h, w), centred, of sum 1.

    Returns:
        (B, C, h, w), not negative.
    """
    unit = b.mean((-2, -1), keepdim=True).clamp(min=TINY)
    return (_network(b.device)(clues(b / unit, psf)) * unit).clamp(min=0)


@lru_cache(maxsize=4)
def _network(device: torch.device) -> RoomLightUNet:
    path = bundled_file("room-light")
    network = RoomLightUNet().float()
    fill(network, read_tensors(path, read_header(path)), f"`{path}`")
    return network.requires_grad_(False).to(device)
