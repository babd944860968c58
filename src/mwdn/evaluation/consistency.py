"""How far to trust a reconstruction of an unknown scene: whether the camera, looking at it, would see the capture."""

from dataclasses import dataclass

import torch

from mwdn.calibration.frames import noise_level
from mwdn.errors import ShapeError
from mwdn.fourier import convolve
from mwdn.solvers.alignment import Pose, align, fine_detail, misfit
from mwdn.types import Measurement, Psf, Scene

LEAST = 0.5
"""The PSF of another camera explained 0.3 and less of what is not noise, the right ones 0.6 and more: real captures,
`benchmarks/trust.py`."""


@dataclass(frozen=True)
class Consistency:
    """What one reconstruction explains of its measurement.

    Detail is what is finer than 30 pixels: brightness and shading are explained by almost anything.

    Args:
        explained: part of the measurement's detail that the reconstruction explains, seen through the PSF.
        possible: part that it could explain at most, because the rest is the sensor's noise.
        contrast: detail that the best scene leaves unexplained through the PSF's mirror images, the best of three,
            over what the best scene leaves through the PSF itself. A wrong PSF, mirrored, is as wrong: 1.
        turn_degrees: turn of the PSF with which it explains the most.
        scale: likewise its relative magnification. An object that is nearer than the calibration's point makes it
            positive.
        haze: part of the light that lies evenly under that PSF, as far as it can be told.
    """

    explained: float
    possible: float
    contrast: float
    turn_degrees: float
    scale: float
    haze: float

    @property
    def doubtful(self) -> bool:
        """Whether the PSF seems not to be the camera's: a mirrored one explains more, or it explains too little."""
        return self.contrast < 1 or self.explained < LEAST * self.possible

    @property
    def sentence(self) -> str:
        """For people."""
        told = f"explains {self.explained:.1%} of the capture's detail, of {self.possible:.1%} that is not noise"
        if self.doubtful:
            why = "the PSF mirrored explains more" if self.contrast < 1 else "that is little"
            return f"{told}; {why}: is it this camera's PSF?"
        changes = [
            f"turned by {self.turn_degrees:.2f} degrees" * (abs(self.turn_degrees) > 0.2),
            f"scaled by {self.scale:+.1%}" * (abs(self.scale) > 0.005),
            f"under {self.haze:.0%} of haze" * (self.haze > 0),
        ]
        pose = ", ".join(filter(None, changes))
        return told + (f"; fits best with the PSF {pose}" if pose else "")


@torch.inference_mode()
def consistency(measurement: Measurement, psf: Psf, scene: Scene, *, pose: Pose | None = None) -> Consistency:
    """Compare a measurement with what the camera would see of its reconstruction.

    The PSF is first turned, scaled and hazed as fits best (`mwdn.solvers.alignment`); of each colour a gain and an even
    light are free.

    A PSF that is merely displaced goes unnoticed: it displaces the picture, and explains the capture as well.

    Args:
        measurement: (1, C, H, W).
        psf: (1, 1 or C, h, w), centred.
        scene: (1, C, H, W), the reconstruction.
        pose: in which the PSF fits best; found unless given.

    Raises:
        ShapeError: more than one measurement, or a scene of another shape.
    """
    if len(measurement) != 1 or scene.shape != measurement.shape:
        raise ShapeError(
            f"`measurement` {tuple(measurement.shape)} and `scene` {tuple(scene.shape)} must be one and of one shape."
        )
    pose = pose or align(measurement, psf)
    fitting = pose.move(psf)
    seen, recorded = fine_detail(convolve(scene.float(), fitting)), fine_detail(measurement.float())
    power = recorded.square().sum((-2, -1)).clamp(min=torch.finfo(torch.float32).tiny)
    power, of_seen = (each.square().sum((-2, -1)).clamp(min=1e-30) for each in (recorded, seen))
    explained = (seen * recorded).sum((-2, -1)).clamp(min=0).square() / of_seen
    noise = noise_level(measurement)[..., 0, 0].square() * recorded[0, 0].numel()
    mirrored = [fitting.flip(axes) for axes in ((-1,), (-2,), (-2, -1))]
    left, *others = misfit(measurement.expand(4, -1, -1, -1), torch.cat([fitting, *mirrored])).tolist()
    return Consistency(
        explained=float(explained.sum() / power.sum()),
        possible=float((1 - noise.sum() / power.sum()).clamp(min=0)),
        contrast=min(others) / max(left, 1e-30),
        turn_degrees=float(pose.turn_degrees),
        scale=float(pose.scale),
        haze=float(pose.haze),
    )
