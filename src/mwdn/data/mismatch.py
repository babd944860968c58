"""How a camera differs from its calibration: rotated, scaled, shifted, blurred, hazy PSF; uneven light."""

import math
from dataclasses import KW_ONLY, dataclass, fields
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.data.random import uniform
from mwdn.errors import ParameterError
from mwdn.optics.psf import unit_sum
from mwdn.optics.warp import affine, hazed
from mwdn.types import Psf, Size

BELOW_1 = (
    *("scale", "haze", "vignetting", "tilt"),
    *("envelope_shift", "aperture_gain", "tails", "depth", "hot_pixels", "gamma_error"),
)
"""Options that are fractions."""

TAIL_RADIUS = (0.01, 0.1)
"""Radius of scattered light over the frame's shorter side: from a few pixels to a tenth of it, where haze begins."""


@checked
@dataclass(frozen=True)
class Mismatch:
    """The [mismatch] of a recipe: how the camera differs from its calibration.

    Each value is the largest magnitude; the actual ones are drawn uniformly for each sample. The second group is what
    real captures have beyond that (`mwdn.data.real_camera`), off by default. What the sensor clips and how its light
    falls off are elsewhere: an `exposure` of [placement] above 1 saturates pixels, `bit_depth` and `black_level` are of
    [sensor], `vignetting` and `tilt` are here.

    Args:
        shift_px: displacement of the PSF.
        turn_degrees: rotation of the PSF.
        scale: relative magnification of the PSF.
        blur_px: standard deviation of a Gaussian blur of the PSF.
        sharpen: sharpening of the PSF by unsharp masking: weight of the difference to a blur by one pixel.
        haze: even light under the PSF, as a fraction of its sum.
        colour_shift_px: displacement of red and blue relative to green, in opposite directions.
        vignetting: relative loss of light in the corners of the measurement.
        tilt: relative gain or loss of light at an edge of the measurement compared with its centre, in a random
            direction.
        grain: relative error of single pixels of the PSF, such as noise of the calibration shot leaves.
        full: always use the largest magnitudes, with random signs.
        exact: fraction of the samples whose camera equals its calibration.

        envelope_shift: displacement of the aperture's shadow against the mask's pattern, over the frame's shorter
            side. They part by (d_a - d_m) tan(angle): 0.5 mm of glass between them and 15 degrees are 0.13 mm, 0.03 to
            0.05 of the frame of a small sensor.
        aperture_gain: relative gain or loss of the PSF's light, smooth over the aperture and different in each colour:
            uneven calibration source, colour filters seen at an angle. 0.3 is typical of a real capture.
        tails: part of the PSF's light in tails that fall with the cube of the distance: scattered light, 0.05 of clean
            optics to 0.3 of a dusty diffuser. Their radius is drawn from `TAIL_RADIUS`.
        off_axis: change of the PSF from the axis to the corner of the scene: 1 is about the paper's camera in front of
            its display, see `mwdn.optics.deviation`.
        depth: magnification of the PSF of near points over that of far ones; a random outline divides the scene. At a
            distance z it is 1 + d / z: with d = 9 mm, 0.03 is between 20 and 60 cm.
        room_light: mean of the room's light on the sensor over the mean of the scene's: even, a slope from none to
            twice the mean, or a spot; in a colour of its own. 0.5 is a lit room.
        hot_pixels: fraction of a colour's pixels that have up to a full scale of dark current.
        eight_bit: fraction of the samples that are read out with 8 bits, where [sensor] has more.
        gamma_coded: fraction of the samples that are stored as 8-bit files of gamma 2.2, clipped at black.
        gamma_error: relative error of the gamma by which these are decoded: with 0.1 by 2.0 to 2.4.
    """

    shift_px: float = 0.5
    turn_degrees: float = 0.5
    scale: float = 0.01
    blur_px: float = 0.7
    haze: float = 0.1
    colour_shift_px: float = 0.3
    vignetting: float = 0.1
    tilt: float = 0.0
    grain: float = 0.0
    sharpen: float = 0.0
    full: bool = False
    exact: float = 0.0
    _: KW_ONLY
    envelope_shift: float = 0.0
    aperture_gain: float = 0.0
    tails: float = 0.0
    off_axis: float = 0.0
    depth: float = 0.0
    room_light: float = 0.0
    hot_pixels: float = 0.0
    eight_bit: float = 0.0
    gamma_coded: float = 0.0
    gamma_error: float = 0.0

    RENAMED: ClassVar[dict[str, str]] = {"background": "haze"}

    def __post_init__(self) -> None:
        for name in ("exact", "eight_bit", "gamma_coded"):
            if not getattr(self, name) <= 1:
                raise ParameterError(
                    f"`{name}` ({getattr(self, name)}) must be in [0, 1]: it is a fraction of the samples."
                )
        for part in fields(self):
            if not getattr(self, part.name) >= 0:
                raise ParameterError(
                    f"`{part.name}` ({getattr(self, part.name)}) must not be negative: it is a magnitude."
                )
        for name in BELOW_1:
            if not getattr(self, name) < 1:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be below 1.")
        if not self.off_axis <= 3:
            raise ParameterError(f"`off_axis` ({self.off_axis}) must be 3 at most: it darkens the corners by 0.3 each.")

    def size(self, generators: list[torch.Generator], largest: float) -> Tensor:
        """(B, 1) random values in [0, largest]."""
        values = uniform(generators, 0.0, 1.0)
        return largest * (torch.ones_like(values) if self.full else values)

    def signed(self, generators: list[torch.Generator], largest: float, count: int = 1) -> Tensor:
        """(B, count) random values in [-largest, largest]."""
        values = uniform(generators, -1.0, 1.0, count)
        return largest * (torch.where(values < 0, -1.0, 1.0) if self.full else values)


REAL_OPTIONS = tuple(part.name for part in fields(Mismatch) if part.kw_only)
"""Options for real captures, off by default. Only append: the position in this list is the number of a random
stream."""

EXACT = Mismatch(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""A camera that equals its calibration."""


def shading(mismatch: Mismatch, generators: list[torch.Generator], size: Size) -> Tensor:
    """(B, 1, H, W) factors of the light at each pixel: vignetting, and a tilt in a random direction."""
    loss = mismatch.size(generators, mismatch.vignetting)[..., None, None]
    y, x = torch.linspace(-1, 1, size[0])[:, None], torch.linspace(-1, 1, size[1])
    factors = 1 - loss * (y.square() + x.square()) / 2
    if mismatch.tilt:
        tilt = mismatch.size(generators, mismatch.tilt)[..., None, None]
        angle = uniform(generators, 0.0, 2 * math.pi)[..., None, None]
        factors = factors * (1 + tilt * (y * angle.sin() + x * angle.cos()))
    return factors


def perturb(psf: Psf, mismatch: Mismatch, generators: list[torch.Generator]) -> Psf:
    """Rotate, scale, shift, sharpen, blur and haze each PSF of a batch at random; sums stay 1.

    Args:
        psf: (B, C, H, W) of unit sum.
        mismatch: largest magnitudes.
        generators: one per sample.

    Raises:
        ParameterError: ``shift_px`` is more than a quarter of the PSF's shorter side.
    """
    if mismatch == EXACT:
        return psf
    batch, channels, height, width = psf.shape
    if mismatch.shift_px > min(height, width) / 4:
        raise ParameterError(
            f"`shift_px` ({mismatch.shift_px:g}) must be at most {min(height, width) // 4}, a quarter of the PSF's "
            "shorter side: a larger shift moves the PSF out of the frame."
        )
    colours = torch.tensor([-1.0, 0.0, 1.0]) if channels == 3 else torch.zeros(channels)
    base = mismatch.signed(generators, mismatch.shift_px, 2)
    spread = mismatch.signed(generators, mismatch.colour_shift_px, 2)
    shift = base[:, None] + colours[:, None] * spread[:, None]
    # Rotate about the PSF's centre, pixel n // 2, which is half a pixel from the middle of an even frame.
    turn = torch.deg2rad(mismatch.signed(generators, mismatch.turn_degrees)[:, 0]).repeat_interleave(channels)
    scale = (1 + mismatch.signed(generators, mismatch.scale)[:, 0]).repeat_interleave(channels)
    half = torch.tensor([height, width]) / 2
    centre = (torch.tensor([height // 2 + 0.5, width // 2 + 0.5]) - half) / half
    theta = affine(turn, scale, scale, shift.flatten(0, 1) / half, width / height)
    centre_xy = centre.flip(0)[:, None]
    theta[..., 2:] += centre_xy - theta[..., :2] @ centre_xy
    planes = psf.reshape(batch * channels, 1, height, width)
    grid = F.affine_grid(theta.to(psf), list(planes.shape), align_corners=False)
    moved = F.grid_sample(planes, grid, mode="bilinear", align_corners=False)
    if mismatch.sharpen:
        amount = mismatch.size(generators, mismatch.sharpen)[:, 0].repeat_interleave(channels)[:, None, None, None]
        fine = moved - _blur(moved, torch.ones(len(moved), device=moved.device))
        moved = (moved + amount.to(moved) * fine).clamp(min=0)
    sigma = mismatch.size(generators, mismatch.blur_px)[:, 0].repeat_interleave(channels)
    blurred = _blur(moved, sigma.to(psf), mismatch.blur_px).reshape(psf.shape)
    if mismatch.grain:
        noise = torch.stack([torch.randn(blurred.shape[1:], generator=g) for g in generators]).to(blurred)
        blurred = blurred * (1 + mismatch.grain * noise).clamp(min=0)
    return hazed(unit_sum(blurred), mismatch.size(generators, mismatch.haze)[..., None, None].to(psf))


def _blur(planes: Tensor, sigma: Tensor, largest: float = 1.0) -> Tensor:
    """Gaussian blur of planes (N, 1, H, W); sigma (N,) in pixels, at most ``largest``; taps to three times that."""
    reach = max(3, math.ceil(3 * largest))
    distance = torch.arange(-reach, reach + 1, device=planes.device)
    weights = torch.exp(-0.5 * (distance / sigma.clamp(min=1e-3)[:, None]).square())
    weights = weights / weights.sum(1, keepdim=True)
    stacked = planes.movedim(0, 1)
    stacked = F.conv2d(stacked, weights[:, None, :, None], padding=(reach, 0), groups=len(planes))
    return F.conv2d(stacked, weights[:, None, None, :], padding=(0, reach), groups=len(planes)).movedim(0, 1)
