"""A camera as the physics of DeepInverse: a `deepinv.physics.LinearPhysics`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mwdn.arguments import MIN_LIGHT, check_options
from mwdn.bridges.forward_model import ForwardModel
from mwdn.errors import ParameterError
from mwdn.fourier import convolve, correlate
from mwdn.optics import Camera, Sensor
from mwdn.optics.psf import checked_psf
from mwdn.optics.sensor import check_sensor_size
from mwdn.runtime.requirement import require
from mwdn.types import Image, Measurement, Psf, Scene, Size

_INSTALL = "`pip install 'mwdn[deepinverse]'`, with a torchvision that was built for the installed torch"

_physics: Any = require("deepinv.physics", "deepinverse", install=_INSTALL)


class LenslessPhysics(_physics.LinearPhysics):  # type: ignore[misc]
    """A lensless camera for DeepInverse: ``y = N(crop(psf * x))``, with the sensor's noise as N.

    The PSF has unit sum and is not negative, so the norm of the operator is at most 1, as DeepInverse recommends.
    ``physics.update(psf=...)`` or ``physics(x, psf=...)`` replaces the PSF, by one for each sample if need be.

    Args:
        camera: with one PSF.
        scene_size: height and width of scenes; the sensor's unless given.
        channels: of scenes and measurements; those of the PSF unless given.
        generator: source of the noise, on the device of the measurements.
        **options: of `deepinv.physics.LinearPhysics`: ``max_iter``, ``tol`` and ``solver`` of the pseudo-inverse,
            ``noise_model`` in place of `SensorNoise`.

    Raises:
        MissingPackageError: deepinv is not installed.
        ShapeError: the PSF has another number of channels, or there is one for each sample of a batch.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        scene_size: Size | None = None,
        channels: int | None = None,
        generator: torch.Generator | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        given = {"camera": camera, "scene_size": scene_size, "channels": channels, "generator": generator}
        check_options(LenslessPhysics, "`LenslessPhysics`", given)
        model = ForwardModel.of(camera, scene_size, channels)
        options.setdefault("noise_model", SensorNoise(camera.sensor, generator))
        super().__init__(img_size=model.scene, device=camera.psf.device, **options)
        self.scene_size, self.sensor_size = model.scene[1:], camera.sensor_size
        self.psf: Tensor
        self.register_buffer("psf", camera.psf)

    def update_parameters(self, psf: Psf | None = None, **others: object) -> None:
        """Replace the PSF; each channel is scaled to unit sum."""
        super().update_parameters(psf=None if psf is None else checked_psf(psf, values=False), **others)

    def A(self, x: Scene, psf: Psf | None = None, **_: object) -> Measurement:  # noqa: N802
        """Light on the sensor, without noise."""
        self.update_parameters(psf=psf)
        return convolve(x, self.psf, size=self.sensor_size)

    def A_adjoint(self, y: Measurement, psf: Psf | None = None, **_: object) -> Scene:  # noqa: N802
        """Exact adjoint of `A`.

        Raises:
            ShapeError: the measurement does not have the sensor's size.
        """
        check_sensor_size(y, self.sensor_size)
        self.update_parameters(psf=psf)
        return correlate(y, self.psf, size=self.scene_size)


class DeepInverseSolver:
    """A reconstructor of DeepInverse as a method of this package, for `mwdn.Reconstructor` and `mwdn.evaluation`.

    It gets the measurement with a peak of 1, and `LenslessPhysics` of the PSF with the noise at this scale; the scale
    is restored.

    Args:
        reconstruct: called as ``reconstruct(y, physics)``: a `deepinv.optim.PGD`, a `deepinv.models.RAM`.
        sensor: whose noise the physics states.
    """

    def __init__(self, reconstruct: Callable[[Measurement, Any], Scene], *, sensor: Sensor | None = None) -> None:
        self.reconstruct, self.sensor = reconstruct, sensor or Sensor()

    @torch.no_grad()
    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """Reconstruct a batch.

        Raises:
            ShapeError: there is one PSF for each sample.
        """
        physics = LenslessPhysics(Camera(psf, sensor=self.sensor), channels=measurement.shape[1])
        peak = measurement.amax((1, 2, 3), keepdim=True).clamp(min=MIN_LIGHT)
        noise, scale = physics.noise_model, peak.flatten()
        noise.update_parameters(gain=noise.gain / scale, sigma=noise.sigma / scale)
        return self.reconstruct(measurement / peak, physics) * peak


class SensorNoise(_physics.PoissonGaussianNoise):  # type: ignore[misc]
    """The noise of `mwdn.Sensor`: shot and read noise, black level, saturation, quantisation.

    Networks of DeepInverse that ask for the noise find ``gain``, the electrons of saturation inverted, and ``sigma``,
    the standard deviation of a dark pixel. Both can be changed, by `update_parameters` or a call.

    Args:
        sensor: the sensor.
        generator: source of the noise.
    """

    def __init__(self, sensor: Sensor, generator: torch.Generator | None = None) -> None:
        step = 1 / (2**sensor.bit_depth - 1) / (1 - sensor.black_level)
        self.rounding = step**2 / 12  # variance
        sigma = ((sensor.read_noise / sensor.full_well) ** 2 + self.rounding) ** 0.5
        super().__init__(gain=1 / sensor.full_well, sigma=sigma, clip_positive=True, rng=generator)
        self.sensor, self.stated = sensor, (float(self.gain), float(self.sigma))

    def forward(
        self,
        x: Image,
        gain: float | Tensor | None = None,
        sigma: float | Tensor | None = None,
        seed: int | None = None,
        **_: object,
    ) -> Image:
        """One capture of the light on the sensor.

        Args:
            x: the light, 1 is saturation.
            gain: one number, in place of that of the sensor.
            sigma: likewise.
            seed: of the noise.

        Raises:
            ParameterError: a number for each sample, or one out of its range.
        """
        self.update_parameters(gain=gain, sigma=sigma)
        self.rng_manual_seed(seed)
        return self._sensor().expose(x, generator=self.rng)

    def _sensor(self) -> Sensor:
        """The sensor with the present gain and sigma."""
        for name in ("gain", "sigma"):
            if getattr(self, name).numel() > 1:
                raise ParameterError(f"`{name}` must be one number: all captures of a batch are by one sensor.")
        gain, sigma = float(self.gain), float(self.sigma)
        if not (gain > 0 and sigma >= 0):
            raise ParameterError(f"`gain` ({gain:g}) must be positive, and `sigma` ({sigma:g}) not negative.")
        if (gain, sigma) == self.stated:
            return self.sensor
        return replace(self.sensor, full_well=1 / gain, read_noise=max(sigma**2 - self.rounding, 0.0) ** 0.5 / gain)
