"""How far to trust a reconstruction without the true scene: how well it explains the measurement through the PSF.

With d the measurement's detail, s the detail of ``psf * scene``, both per channel c, and n pixels of white noise sigma:

    explained = sum_c max(<s_c, d_c>, 0)^2 / |s_c|^2  /  sum_c |d_c|^2
    possible  = 1 - sum_c n sigma_c^2                 /  sum_c |d_c|^2
    contrast  = min_g m(g psf) / m(psf)

`explained` is the part of the detail's energy that s reproduces with the best gain for each channel. `m(h)` is the part
of it that the best scene leaves through a PSF h (`mwdn.solvers.alignment.misfit`), and g runs over the other seven
mirror images and quarter turns. Detail is finer than about 30 pixels: almost any scene explains brightness and shading.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from mwdn.errors import ShapeError
from mwdn.fourier.convolution import convolve
from mwdn.optics.noise import noise_level
from mwdn.solvers.alignment import Pose, align, fine_detail, misfit
from mwdn.types import Measurement, Psf, Scene

LEAST_EXPLAINED = 0.25
"""Smallest trusted ``explained / possible``. On real captures the right PSF reaches 0.32 and more. Another camera's PSF
can reach as much on a simple scene, but then its mirror images do, too (`benchmarks/trust.py`)."""

LEAST_MARGIN = 0.01
"""Smallest trusted ``(contrast - 1) explained / possible``. On real captures 0.035 and more with the right PSF, 0.013
and less with wrong ones, mostly below 0."""

_QUARTER_TURN = Pose(torch.tensor([90.0]), torch.zeros(1))


@dataclass(frozen=True)
class Consistency:
    """How well a reconstruction explains its measurement; the equations are above.

    Args:
        explained: part of the measurement's detail that the reconstruction reproduces through the PSF.
        possible: part of it that is not the sensor's noise: the most that can be explained.
        contrast: misfit of the best of the PSF's seven mirror images and quarter turns, over the misfit of the PSF.
            Above 1 for the right PSF. The images of a wrong PSF are no worse than it is, so the best one fits better
            and the contrast is mostly below 1.
        turn_degrees: rotation of the PSF that fits best.
        scale: its relative magnification; positive for objects nearer than the point of the calibration.
        haze: estimated fraction of the light that is spread evenly under that PSF.
    """

    explained: float
    possible: float
    contrast: float
    turn_degrees: float
    scale: float
    haze: float

    @property
    def doubtful(self) -> bool:
        """Whether the PSF is probably not this camera's: a mirror image fits as well, or too little is explained."""
        ambiguous = self.explained * (self.contrast - 1) < LEAST_MARGIN * self.possible
        return ambiguous or self.explained < LEAST_EXPLAINED * self.possible

    @property
    def sentence(self) -> str:
        """A one-line summary."""
        summary = f"explains {self.explained:.1%} of the capture's detail, of {self.possible:.1%} that is not noise"
        if self.doubtful:
            little = self.explained < LEAST_EXPLAINED * self.possible and self.contrast > 1
            why = "that is little" if little else "the PSF mirrored or turned explains as much"
            return f"{summary}; {why}: is it this camera's PSF?"
        changes = [
            f"turned by {self.turn_degrees:.2f} degrees" * (abs(self.turn_degrees) > 0.2),
            f"scaled by {self.scale:+.1%}" * (abs(self.scale) > 0.005),
            f"under {self.haze:.0%} of haze" * (self.haze > 0),
        ]
        pose = ", ".join(filter(None, changes))
        return summary + (f"; fits best with the PSF {pose}" if pose else "")


@torch.inference_mode()
def consistency(measurement: Measurement, psf: Psf, scene: Scene, *, pose: Pose | None = None) -> Consistency:
    """Compare a measurement with the forward model of its reconstruction.

    The scene passes the PSF in its best pose (rotation, scale and haze, `mwdn.solvers.alignment`) and the PSF as it is;
    the better one counts. The gain and an even background are free in each channel.

    A merely displaced PSF goes unnoticed: it displaces the reconstruction and explains the measurement as well.

    Args:
        measurement: (1, C, H, W).
        psf: (1, 1 or C, h, w), centred.
        scene: (1, C, H, W), the reconstruction.
        pose: the best pose of the PSF; estimated by `align` unless given.

    Raises:
        ShapeError: more than one measurement, or a scene of another shape.
    """
    if len(measurement) != 1 or scene.shape != measurement.shape:
        raise ShapeError(
            f"`measurement` {tuple(measurement.shape)} and `scene` {tuple(scene.shape)} must have one shape "
            "(1, C, H, W). Compare one measurement at a time."
        )
    pose = pose or align(measurement, psf)
    unit = measurement.abs().amax().clamp(min=torch.finfo(torch.float32).tiny)
    measurement, scene = measurement.float() / unit, scene.float() / unit
    aligned = pose.move(psf)
    d = fine_detail(measurement)
    s = fine_detail(convolve(scene.expand(2, -1, -1, -1), torch.cat([aligned, psf.float()])))
    d_energy, s_energy = (detail.square().sum((-2, -1)).clamp(min=1e-30) for detail in (d, s))
    explained = (s * d).sum((-2, -1)).clamp(min=0).square() / s_energy
    noise = noise_level(measurement)[..., 0, 0].square() * d[0, 0].numel()
    images = _mirrored(aligned), _mirrored(_QUARTER_TURN.move(aligned))
    of_psf, *of_images = torch.cat([misfit(measurement.expand(4, -1, -1, -1), four) for four in images]).tolist()
    return Consistency(
        explained=float(explained.sum(1).max() / d_energy.sum()),
        possible=float((1 - noise.sum() / d_energy.sum()).clamp(min=0)),
        contrast=min(of_images) / max(of_psf, 1e-30),
        turn_degrees=float(pose.turn_degrees),
        scale=float(pose.scale),
        haze=float(pose.haze),
    )


def _mirrored(psf: Psf) -> Tensor:
    """A PSF, mirrored horizontally, vertically, and both: (4, C, h, w)."""
    return torch.cat([psf, psf.flip(-1), psf.flip(-2), psf.flip(-2, -1)])
