"""The forward model of a lensless camera: ``crop(psf * scene)``, then a sensor."""

from dataclasses import dataclass, field

import torch

from mwdn.arguments import checked
from mwdn.errors import ShapeError
from mwdn.fourier.convolution import convolve, correlate
from mwdn.optics.psf import checked_psf, psf_hash
from mwdn.optics.sensor import Sensor, check_sensor_size
from mwdn.types import Image, Measurement, Psf, Scene, Size, size_of


@checked
@dataclass(frozen=True, eq=False)
class Camera:
    """Forward model of a lensless camera: convolution with the PSF, crop, sensor noise. Computed in float32.

    Args:
        psf: (1 or B, 1 or C, h, w), centred, not negative. Each channel is scaled to unit sum, so that the energy of
            the scene is kept; `mwdn.convolve` uses a kernel as it is.
        size: height and width of the sensor in pixels; the PSF's unless given.
        sensor: noise, saturation and quantisation, which `simulate` applies and `forward` does not.

    Raises:
        PsfError: the PSF is negative, not finite, or dark.
        ParameterError: an argument is of another type.
        ShapeError: ``size`` is not positive.

    References:
        Eq. (1) of the MWDN paper.
    """

    psf: Psf
    size: Size | None = None
    sensor: Sensor = field(default_factory=Sensor)

    def __post_init__(self) -> None:
        object.__setattr__(self, "psf", checked_psf(self.psf))
        if min(self.sensor_size) < 1:
            raise ShapeError(f"`size` {tuple(self.sensor_size)} must be positive: height and width in pixels.")

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.psf.shape[-3:]))
        return f"Camera(PSF {psf_hash(self.psf)}, {shape}, size={self.sensor_size}, {self.sensor})"

    @property
    def sensor_size(self) -> Size:
        """Height and width of a measurement."""
        return self.size or size_of(self.psf)

    def forward(self, scene: Scene) -> Measurement:
        """Light on the sensor: the scene convolved with the PSF, cropped to the sensor."""
        return convolve(scene, self.psf, size=self.sensor_size)

    def __call__(self, scene: Scene) -> Measurement:
        """The same as `forward`."""
        return self.forward(scene)

    def adjoint(self, measurement: Measurement, *, scene_size: Size | None = None) -> Scene:
        """Exact adjoint of `forward` for scenes of ``scene_size`` (the sensor's unless given).

        Raises:
            ShapeError: the measurement does not have `sensor_size`.
        """
        check_sensor_size(measurement, self.sensor_size)
        return correlate(measurement, self.psf, size=scene_size)

    def simulate(self, scene: Scene, *, generator: torch.Generator | None = None) -> Image:
        """A capture: `forward`, then noise, black level, saturation and quantisation of the sensor.

        Args:
            scene: (B, C, H, W), linear light; a pixel that receives the light of a scene pixel of 1 just saturates.
            generator: source of the noise, on the scene's device.

        Returns:
            (B, C, *sensor_size), black level subtracted, saturation at 1; noise makes dark pixels negative.
        """
        return self.sensor.expose(self.forward(scene), generator=generator)
