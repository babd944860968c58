"""How well a reconstruction explains its measurement through the PSF, without the true scene.

With d the measurement's detail, s the detail of ``psf * scene``, both per channel c, and n pixels of white noise sigma:

    explained = sum_c max(<s_c, d_c>, 0)^2 / |s_c|^2  /  sum_c |d_c|^2
    possible  = 1 - sum_c n sigma_c^2                 /  sum_c |d_c|^2

`explained` is the part of the detail's energy that s reproduces with the best gain for each channel. Detail is finer
than about 30 pixels: almost any scene explains brightness and shading.

This is a statement about the picture. Whether the PSF is right is another question, which does not depend on the
method: `mwdn.diagnosis.orientation`.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mwdn.arguments import check_batch
from mwdn.errors import ShapeError
from mwdn.fourier.convolution import check_fit, convolve
from mwdn.optics.noise import noise_level
from mwdn.optics.psf import checked_psf
from mwdn.optics.saturation import saturated_pixels
from mwdn.solvers.alignment import align, fine_detail
from mwdn.solvers.pose import Pose
from mwdn.types import TINY, Measurement, Psf, Scene


@dataclass(frozen=True)
class Consistency:
    """How well a reconstruction explains its measurement; the equations are above.

    Args:
        explained: part of the measurement's detail that the reconstruction reproduces through the PSF.
        possible: part of it that is not the sensor's noise: the most that can be explained.
        turn_degrees: rotation of the PSF that fits best.
        scale: its relative magnification; positive for objects nearer than the point of the calibration.
        haze: estimated fraction of the light that is spread evenly under that PSF.
        envelope_down: displacement of the aperture's shadow in that PSF, over its shorter side.
        envelope_right: likewise.
    """

    explained: float
    possible: float
    turn_degrees: float
    scale: float
    haze: float
    envelope_down: float = 0.0
    envelope_right: float = 0.0

    @property
    def sentence(self) -> str:
        """A one-line summary."""
        # The noise estimate of a raw mosaic counts its cells as noise.
        noise = f" ({self.possible:.0%} is not noise)" if self.explained <= self.possible else ""
        summary = f"the picture reproduces {self.explained:.0%} of the capture's detail{noise}"
        displacement = math.hypot(self.envelope_down, self.envelope_right)
        changes = {
            f"turned by {self.turn_degrees:.2f} degrees": abs(self.turn_degrees) > 0.2,
            f"scaled by {self.scale:+.1%}": abs(self.scale) > 0.005,
            f"behind an aperture displaced by {displacement:.1%} of the frame": displacement > 0.005,
            f"under {self.haze:.0%} of haze": self.haze >= 0.02,
        }
        pose = ", ".join(change for change, is_large in changes.items() if is_large)
        return f"{summary}; fits best with the PSF {pose}" if pose else summary


@torch.inference_mode()
def consistency(measurement: Measurement, psf: Psf, scene: Scene, *, pose: Pose | None = None) -> Consistency:
    """Compare a measurement with the forward model of its reconstruction.

    The scene is convolved with the PSF in its best pose (`mwdn.solvers.alignment`) and with the PSF as it is; the
    better result counts. The gain and an even background are free in each channel. Saturated pixels
    (`mwdn.optics.saturation`) count only where the prediction is darker.

    A PSF that is only displaced is not detected: it displaces the reconstruction and explains the measurement equally
    well.

    Args:
        measurement: (1, C, H, W).
        psf: (1, 1 or C, h, w), centred.
        scene: (1, C, H, W), the reconstruction.
        pose: the best pose of the PSF; estimated by `align` unless given.

    Raises:
        ShapeError: more than one measurement, or a scene of another shape.
    """
    check_fit(measurement, psf, "measurement")
    check_batch(scene, "scene")
    if len(measurement) != 1 or scene.shape != measurement.shape:
        raise ShapeError(
            f"`measurement` {tuple(measurement.shape)} and `scene` {tuple(scene.shape)} must have one shape "
            "(1, C, H, W). Compare one measurement at a time."
        )
    psf = checked_psf(psf)
    pose = pose or align(measurement, psf)
    unit = measurement.abs().amax().clamp(min=TINY)
    measurement, scene = measurement.float() / unit, scene.float() / unit
    aligned = pose.move(psf)
    d = fine_detail(measurement)
    light = convolve(scene.expand(2, -1, -1, -1), torch.cat([aligned, psf.float()]))
    s = fine_detail(torch.where(saturated_pixels(measurement), light.minimum(measurement), light))
    d_energy, s_energy = (detail.square().sum((-2, -1)).clamp(min=1e-30) for detail in (d, s))
    explained = (s * d).sum((-2, -1)).clamp(min=0).square() / s_energy
    return Consistency(
        explained=float(explained.sum(1).max() / d_energy.sum()),
        possible=float(not_noise(measurement, d)),
        **pose.numbers(),
    )


def not_noise(measurement: Measurement, detail: Tensor) -> Tensor:
    """Part of a measurement's detail (1, C, H, W) that is not white noise: `Consistency.possible`."""
    noise = noise_level(measurement)[..., 0, 0].square().sum() * detail[0, 0].numel()
    return (1 - noise / detail.square().sum().clamp(min=1e-30)).clamp(min=0)
