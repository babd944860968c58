"""The difference of a capture's PSF from the calibrated one, as `mwdn.solvers.alignment` estimates it."""

from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.optics.aperture import displaced_envelope
from mwdn.optics.psf import unit_sum
from mwdn.optics.warp import hazed, warp
from mwdn.types import Psf

POSE_BLUR = 0.06
"""See `displaced_envelope`: wider than in [mismatch], which most real captures fit better."""


class Pose(NamedTuple):
    """Difference of each capture's PSF from the calibrated one.

    Args:
        turn_degrees: (B,), clockwise.
        scale: (B,), relative magnification, 0 for none.
        haze: (B,), fraction of the light that is spread evenly under the PSF: scattered by the mask or the sensor's
            glass, or subtracted from the PSF as if it were the sensor's black level.
        envelope: (B, 2), displacement of the aperture's shadow against the mask's pattern, down and right, over the
            PSF's shorter side; or `None` for none.
    """

    turn_degrees: Tensor
    scale: Tensor
    haze: Tensor | float = 0.0
    envelope: Tensor | None = None

    def __repr__(self) -> str:
        if len(self.turn_degrees) != 1:
            return f"Pose(of {len(self.turn_degrees)} captures)"
        return f"Pose({', '.join(f'{name}={value:.3g}' for name, value in self.numbers().items())})"

    def numbers(self) -> dict[str, float]:
        """The pose of a single capture; `envelope` as ``envelope_down`` and ``envelope_right``."""
        down, right = (0.0, 0.0) if self.envelope is None else self.envelope[0].tolist()
        haze = torch.as_tensor(self.haze).mean()
        values = {"turn_degrees": self.turn_degrees, "scale": self.scale, "haze": haze}
        numbers = {name: float(value) for name, value in values.items()}
        return numbers | {"envelope_down": down, "envelope_right": right}

    def move(self, psf: Psf) -> Tensor:
        """The PSF (1 or B, C, h, w) of each capture: (B, C, h, w), each colour of unit sum."""
        angle, size = torch.deg2rad(self.turn_degrees), 1 + self.scale
        c, s = size * angle.cos(), size * angle.sin()
        moved = warp(psf, torch.stack([torch.stack([c, s], -1), torch.stack([-s, c], -1)], 1))
        if self.envelope is not None and self.envelope.any():
            moved = displaced_envelope(moved, self.envelope * min(psf.shape[-2:]), blur=POSE_BLUR)
        return hazed(unit_sum(moved), torch.as_tensor(self.haze, device=moved.device).reshape(-1, 1, 1, 1))
