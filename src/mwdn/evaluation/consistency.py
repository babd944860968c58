"""How far to trust a reconstruction of an unknown scene: whether the camera, looking at it, would see the capture."""

from dataclasses import dataclass

import torch
from torch import Tensor

from mwdn.errors import ShapeError
from mwdn.fourier.convolution import convolve
from mwdn.optics.noise import noise_level
from mwdn.solvers.alignment import Pose, align, fine_detail, misfit
from mwdn.types import Measurement, Psf, Scene

LEAST = 0.25
"""Of real captures the right PSF explains 0.32 and more of what is not noise. One of another camera may explain as much
of a plain scene, but then so do its own mirror images: `benchmarks/trust.py`."""

CLEAR = 0.01
"""How far the contrast is above 1, times that part: 0.035 and more with the right PSF, 0.013 and less with others, most
of them below 0."""


_QUARTER = Pose(torch.tensor([90.0]), torch.zeros(1))


@dataclass(frozen=True)
class Consistency:
    """What one reconstruction explains of its measurement.

    Detail is what is finer than 30 pixels: brightness and shading are explained by almost anything.

    Args:
        explained: part of the measurement's detail that the reconstruction explains, seen through the PSF.
        possible: part that it could explain at most, because the rest is the sensor's noise.
        contrast: detail that the best scene leaves unexplained through the PSF's mirror images and quarter turns, the
            best of seven, over what the best scene leaves through the PSF itself. Such an image of a wrong PSF is no
            more wrong: the best of them leaves less, and the contrast is below 1.
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
        """Whether the PSF seems not to be the camera's: an image of it explains as much, or it explains too little."""
        unclear = self.explained * (self.contrast - 1) < CLEAR * self.possible
        return unclear or self.explained < LEAST * self.possible

    @property
    def sentence(self) -> str:
        """For people."""
        told = f"explains {self.explained:.1%} of the capture's detail, of {self.possible:.1%} that is not noise"
        if self.doubtful:
            little = self.explained < LEAST * self.possible and self.contrast > 1
            why = "that is little" if little else "the PSF mirrored or turned explains as much"
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

    The PSF is first turned, scaled and hazed as fits best (`mwdn.solvers.alignment`); a scene that was made with the
    PSF as it is may be seen through that one as well. Of each colour a gain and an even light are free.

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
    unit = measurement.abs().amax().clamp(min=torch.finfo(torch.float32).tiny)
    measurement, scene = measurement.float() / unit, scene.float() / unit
    fitting = pose.move(psf)
    recorded = fine_detail(measurement)
    seen = fine_detail(convolve(scene.expand(2, -1, -1, -1), torch.cat([fitting, psf.float()])))
    power, of_seen = (each.square().sum((-2, -1)).clamp(min=1e-30) for each in (recorded, seen))
    explained = (seen * recorded).sum((-2, -1)).clamp(min=0).square() / of_seen
    noise = noise_level(measurement)[..., 0, 0].square() * recorded[0, 0].numel()
    images = _mirrored(fitting), _mirrored(_QUARTER.move(fitting))
    left, *others = torch.cat([misfit(measurement.expand(4, -1, -1, -1), four) for four in images]).tolist()
    return Consistency(
        explained=float(explained.sum(1).max() / power.sum()),
        possible=float((1 - noise.sum() / power.sum()).clamp(min=0)),
        contrast=min(others) / max(left, 1e-30),
        turn_degrees=float(pose.turn_degrees),
        scale=float(pose.scale),
        haze=float(pose.haze),
    )


def _mirrored(psf: Psf) -> Tensor:
    """A PSF, its two mirror images, and both at once: (4, C, h, w)."""
    return torch.cat([psf, psf.flip(-1), psf.flip(-2), psf.flip(-2, -1)])
