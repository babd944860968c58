"""The shapes of a camera's forward model, as the operators of other libraries need them."""

from typing import NamedTuple

from mwdn.errors import ShapeError
from mwdn.optics import Camera, FieldCamera
from mwdn.types import Measurement, Scene, Size

Shape = tuple[int, int, int]
"""(channels, height, width)."""


class ForwardModel(NamedTuple):
    """A camera for scenes of one shape: a matrix, in other words.

    Args:
        camera: with one PSF, not one for each sample of a batch.
        scene: shape of a scene.
        measurement: shape of a measurement.
    """

    camera: Camera | FieldCamera
    scene: Shape
    measurement: Shape

    @classmethod
    def of(cls, camera: Camera | FieldCamera, scene_size: Size | None, channels: int | None) -> "ForwardModel":
        """The forward model of a camera.

        Args:
            camera: with one PSF.
            scene_size: height and width of scenes; the sensor's unless given. A `FieldCamera` has its own.
            channels: of scenes and measurements; those of the PSF unless given.

        Raises:
            ShapeError: the PSF has another number of channels than 1 or these; or there is one for each sample; or the
                size is not that of a `FieldCamera`; or a number is not positive.
        """
        if min(scene_size or (1, 1)) < 1:
            raise ShapeError(f"`scene_size` {scene_size} must be positive.")
        if channels is not None and channels < 1:
            raise ShapeError(f"`channels` ({channels}) must be positive.")
        if isinstance(camera, FieldCamera):
            if scene_size not in (None, camera.scene_size):
                raise ShapeError(f"`scene_size` {scene_size} must be the camera's own, {camera.scene_size}.")
            scene_size, psf_channels = camera.scene_size, camera.kernels.shape[1]
        else:
            samples, psf_channels = camera.psf.shape[:2]
            if samples != 1:
                raise ShapeError(f"`camera` has {samples} PSFs; an operator has one. Pick it: `Camera(psf[:1])`.")
        channels = channels or psf_channels
        if psf_channels not in (1, channels):
            raise ShapeError(f"`channels` ({channels}) must be {psf_channels} as in the PSF, or the PSF must have 1.")
        return cls(camera, (channels, *(scene_size or camera.sensor_size)), (channels, *camera.sensor_size))

    def forward(self, scene: Scene) -> Measurement:
        """Light on the sensor (B, C, h, w) from scenes (B, C, H, W)."""
        return self.camera.forward(scene)

    def adjoint(self, measurement: Measurement) -> Scene:
        """Exact adjoint of `forward`."""
        if isinstance(self.camera, FieldCamera):
            return self.camera.adjoint(measurement)
        return self.camera.adjoint(measurement, scene_size=self.scene[1:])
