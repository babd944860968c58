"""A camera that differs from its calibration in a fixed way, for robustness tests."""

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.optics.field import Aberration, FieldCamera, field_psfs
from mwdn.optics.psf import unit_sum
from mwdn.optics.warp import hazed, warp
from mwdn.types import Psf, Size, size_of

OFF_AXIS = Aberration(scale=0.005, stretch=0.02, vignetting=0.3)
"""Change of the PSF at the corner for an `off_axis` of 1, except the blur.

The corner of a 14 cm display at 20 cm is 26 degrees off the axis: cos^4 leaves 65 % of the light. The path from the
mask to the sensor is longer there: light that the mask deflects by d on the axis, up to 0.27 mm in a pattern of 2.5 mm,
lands farther out by (1 / cos^3 - 1) d = 0.38 d radially and by (1 / cos - 1) d = 0.1 d tangentially. With the mean
deflection, half of the largest, the pattern grows by 2 % radially (here 2.5 %: `scale` and `stretch`) and by 0.5 %
tangentially.
"""

BLUR = 0.005
"""Blur at the corner for an `off_axis` of 1, over the shorter side of the frame (assumed): 1.6 pixels of 320."""

GRID = 5
"""PSFs are computed on a grid of 5 x 5 points of the field."""

RANK = 8
"""Kernels that approximate these 25 PSFs; 2 % of the norm is left for the paper's camera at `off_axis` 1."""


def off_axis_change(amount: float, size: Size) -> Aberration:
    """Change of a PSF towards the corner of the field, `amount` in units of `OFF_AXIS`, for a frame of this size."""
    return replace(OFF_AXIS * amount, blur_px=BLUR * amount * min(size))


@checked
@dataclass(frozen=True)
class Deviation:
    """How the true camera differs from its calibration: fixed, signed sizes (`mwdn.data.mismatch` draws random ones).

    Args:
        shift_px: displacement of the PSF down, and the same to the right; its length is sqrt(2) times this.
        turn_degrees: rotation of the PSF, clockwise.
        scale: relative magnification of the PSF.
        haze: part of the PSF's light that is spread evenly over the frame.
        off_axis: change of the PSF from the axis to the corner, in units of `OFF_AXIS`; 1 is about the paper's
            camera in front of its display.

    Raises:
        ParameterError: `haze` outside [0, 1), `scale` of -0.9 or less, `off_axis` outside its range.
    """

    shift_px: float = 0.0
    turn_degrees: float = 0.0
    scale: float = 0.0
    haze: float = 0.0
    off_axis: float = 0.0

    RENAMED: ClassVar[dict[str, str]] = {"background": "haze"}

    def __post_init__(self) -> None:
        if not 0 <= self.haze < 1:
            raise ParameterError(f"`haze` ({self.haze}) must be in [0, 1): a fraction of the light.")
        if not self.scale > -0.9:
            raise ParameterError(f"`scale` ({self.scale}) must be above -0.9: a relative change.")
        if not 0 <= self.off_axis < 1 / OFF_AXIS.vignetting:
            raise ParameterError(
                f"`off_axis` ({self.off_axis}) must be from 0 to {1 / OFF_AXIS.vignetting:.1f}: beyond it no light is "
                "left in the corners."
            )

    def plus(self, name: str, size: float) -> "Deviation":
        """The same deviation with one number larger by ``size``.

        Raises:
            ParameterError: unknown name, or the number leaves its range.
        """
        names = [field.name for field in fields(self)]
        if name not in names:
            raise ParameterError(f"`name` ({name}) must be one of {', '.join(names)}.")
        return replace(self, **{name: getattr(self, name) + size})

    def camera(self, psf: Psf) -> FieldCamera:
        """The true camera, given the calibrated PSF.

        Args:
            psf: (1, C, H, W) of unit sum; scenes and measurements have its size.
        """
        size = size_of(psf)
        angle = math.radians(self.turn_degrees)
        # Acts on (row, column): a clockwise turn moves what lies to the right downwards.
        turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        if self.shift_px or self.turn_degrees or self.scale:
            psf = warp(psf, (1 + self.scale) * turn, (self.shift_px, self.shift_px))
            psf = unit_sum(psf)
        psfs = field_psfs(psf, (GRID, GRID) if self.off_axis else (1, 1), off_axis_change(self.off_axis, size))
        return FieldCamera.from_psfs(hazed(psfs, self.haze), size, rank=RANK)
