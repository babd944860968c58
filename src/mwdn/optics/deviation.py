"""A camera that is not what its calibration says, in the way a real one is: always the same."""

import math
from dataclasses import dataclass, fields, replace

import torch

from mwdn.errors import ParameterError
from mwdn.optics.field import Aberration, FieldCamera, field_psfs
from mwdn.optics.warp import hazed, warp
from mwdn.types import Psf

OFF_AXIS = Aberration(scale=0.005, stretch=0.02, vignetting=0.3)
"""What `off_axis` of 1 is at the corner, besides the blur.

A display of 14 cm at 20 cm ends 26 degrees off the axis: cos^4 of it leaves 65 % of the light. The way from the mask to
the sensor is longer there, and what the mask bends, 0.27 mm of a pattern of 2.5 mm (`docs/masks.md`), lands farther out
by 1 / cos^3 - 1 = 0.38 of it in one direction, 0.1 in the other. Bent by half of this on the average, the pattern grows
by 2 % and 0.5 %.
"""

BLUR = 0.005
"""Its blur at the corner, an assumption, over the shorter side of the frame: 1.6 pixels of 320."""

GRID = 5
"""Points along each side of the field whose PSFs are computed."""

RANK = 8
"""Kernels that stand for these 25 PSFs: of the paper's camera they leave out 2 % of the norm at `off_axis` 1."""


@dataclass(frozen=True)
class Deviation:
    """How the true camera differs from its calibration: exact, signed sizes, not draws as in `mwdn.data` `Mismatch`.

    Args:
        shift_px: displacement of the PSF, down and right alike: the length is sqrt(2) times as much.
        turn_degrees: rotation of the PSF, clockwise.
        scale: relative magnification of the PSF.
        background: even light under the PSF, as a part of its sum.
        off_axis: how much the PSF changes from the axis to the corner, in units of `OFF_AXIS`; 1 is the paper's
            camera before its display, roughly.

    Raises:
        ParameterError: a background outside [0, 1), a PSF shrunk to nothing, a negative change off the axis.
    """

    shift_px: float = 0.0
    turn_degrees: float = 0.0
    scale: float = 0.0
    background: float = 0.0
    off_axis: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.background < 1:
            raise ParameterError(f"`background` ({self.background}) must be in [0, 1): a part of the PSF's sum.")
        if not self.scale > -0.9:
            raise ParameterError(f"`scale` ({self.scale}) must be above -0.9: a relative change.")
        if not self.off_axis >= 0:
            raise ParameterError(f"`off_axis` ({self.off_axis}) must not be negative: it is a size.")

    def plus(self, name: str, size: float) -> "Deviation":
        """The same with one number larger by ``size``.

        Raises:
            ParameterError: no such number, or it leaves its range.
        """
        if name not in (known := [part.name for part in fields(self)]):
            raise ParameterError(f"`{name}` must be one of {', '.join(known)}.")
        return replace(self, **{name: getattr(self, name) + size})

    def camera(self, psf: Psf) -> FieldCamera:
        """The true camera of a calibration with this PSF.

        Args:
            psf: (1, C, H, W) of unit sum; scenes and measurements have its size.
        """
        size = psf.shape[-2], psf.shape[-1]
        angle = math.radians(self.turn_degrees)
        # Of (row, column) displacements: what lies to the right goes down.
        turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        if self.shift_px or self.turn_degrees or self.scale:
            psf = warp(psf, (1 + self.scale) * turn, (self.shift_px, self.shift_px))
            psf = psf / psf.sum((-2, -1), keepdim=True).clamp(min=1e-12)
        change = replace(OFF_AXIS * self.off_axis, blur_px=BLUR * self.off_axis * min(size))
        psfs = field_psfs(psf, (GRID, GRID) if self.off_axis else (1, 1), change)
        return FieldCamera.from_psfs(hazed(psfs, self.background), size, rank=RANK)
