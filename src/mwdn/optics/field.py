"""A camera whose PSF changes over its field of view: the forward model without shift invariance."""

import math
from dataclasses import dataclass, field, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import check_at_least, check_batch, checked
from mwdn.errors import ParameterError, ShapeError
from mwdn.fourier.convolution import convolve, correlate
from mwdn.fourier.transforms import fast_length, gaussian_transfer, inverse_spectrum, spectrum
from mwdn.optics.sensor import Sensor, check_sensor_size
from mwdn.optics.warp import warp
from mwdn.types import Image, Measurement, Psf, Scene, Size, size_of

FieldPsfs = Float[Tensor, "rows columns psf_channel psf_height psf_width"]
"""PSFs of points on a grid that spans the scene from corner to corner, each centred like the PSF on the axis."""


@checked
@dataclass(frozen=True)
class Aberration:
    """Change of a PSF at the corner of the field; it grows with the square of the distance from the axis.

    Args:
        scale: relative magnification of the PSF at the corner.
        stretch: further relative magnification at the corner, in the radial direction only: oblique light.
        blur_px: standard deviation of a Gaussian blur at the corner; its variance grows with the square of the
            distance from the axis.
        vignetting: fraction of the light that is lost at the corner.

    Raises:
        ParameterError: negative `blur_px`, `vignetting` outside [0, 1], `scale` or `stretch` of -0.9 or less.
    """

    scale: float = 0.0
    stretch: float = 0.0
    blur_px: float = 0.0
    vignetting: float = 0.0

    def __post_init__(self) -> None:
        if not self.blur_px >= 0:
            raise ParameterError(f"`blur_px` ({self.blur_px}) must not be negative: it is a standard deviation.")
        if not 0 <= self.vignetting <= 1:
            raise ParameterError(f"`vignetting` ({self.vignetting}) must be in [0, 1]: a fraction of the light.")
        for name in ("scale", "stretch"):
            if not getattr(self, name) > -0.9:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be above -0.9: a relative change.")

    def __mul__(self, factor: float) -> "Aberration":
        """Multiply all four changes by a factor."""
        return Aberration(**{part.name: getattr(self, part.name) * factor for part in fields(self)})

    def at(self, psf: Psf, y: float, x: float) -> Psf:
        """The PSF of a point off the axis.

        Args:
            psf: (1, C, h, w), the PSF on the axis.
            y: distance of the point below the axis, over half the field's height: 1 at its lower border.
            x: distance to the right, over half the field's width.

        Returns:
            (1, C, h, w). Its sum falls by the vignetting, and by the light outside the frame.
        """
        square = (y * y + x * x) / 2
        if not square:
            return psf
        # With the unit vector e away from the axis: (1 + s scale) I + s stretch e e^T, s = (y^2 + x^2) / 2.
        e = torch.tensor([y, x]) / math.hypot(y, x)
        matrix = (1 + self.scale * square) * torch.eye(2) + self.stretch * square * torch.outer(e, e)
        changed = warp(psf, matrix) if self.scale or self.stretch else psf
        if self.blur_px:
            changed = gaussian_blur(changed, self.blur_px * math.sqrt(square)).clamp(min=0)
        # `warp` keeps the brightness; division by the determinant keeps the total light.
        return changed * (1 - self.vignetting * square) / float(matrix.det())


def field_psfs(psf: Psf, grid: Size, aberration: Aberration) -> FieldPsfs:
    """PSFs at the points of a grid, for a camera with this PSF on its axis.

    Args:
        psf: (1, C, h, w), centred.
        grid: rows and columns of points, evenly from border to border of the scene; one point lies at its middle.
        aberration: change of the PSF off the axis.

    Returns:
        (rows, columns, C, h, w); a sum falls by the vignetting, and by the light outside the frame.

    Raises:
        ParameterError: the grid has no points.
    """
    if min(grid) < 1:
        raise ParameterError(f"`grid` {grid} must have at least one point along each axis: (5, 5).")
    rows, columns = ([2 * i / (n - 1) - 1 if n > 1 else 0.0 for i in range(n)] for n in grid)
    return torch.stack([torch.stack([aberration.at(psf, y, x)[0] for x in columns]) for y in rows])


@dataclass(frozen=True, eq=False)
class FieldCamera:
    """A camera whose PSF changes smoothly over the field: ``crop(sum_k h_k * (w_k . scene))``, then a sensor.

    A point at scene pixel p casts the PSF ``sum_k w_k(p) h_k``, displaced to p. One kernel h_1 with w_1 = 1 is
    `mwdn.Camera`.

    Args:
        kernels: h_k, (K, 1 or C, h, w), centred at ``(h // 2, w // 2)``; of either sign.
        weights: w_k, (K, 1, H, W), maps over the scene.
        size: height and width of the sensor; the scene's unless given.
        sensor: noise, saturation and quantisation.
        truncation: relative norm of the difference between the PSFs given to `from_psfs` and these kernels.

    References:
        N. Antipa et al., Optica 5, 1 (2018), for the local convolution model; R. C. Flicker and F. J. Rigaut,
        J. Opt. Soc. Am. A 22, 504 (2005), for PSFs as sums of a few kernels.
    """

    kernels: Float[Tensor, "rank psf_channel psf_height psf_width"]
    weights: Float[Tensor, "rank 1 scene_height scene_width"]
    size: Size | None = None
    sensor: Sensor = field(default_factory=Sensor)
    truncation: float = 0.0

    @classmethod
    def from_psfs(
        cls, psfs: FieldPsfs, scene_size: Size, *, rank: int | None = None, size: Size | None = None
    ) -> "FieldCamera":
        """Factorise PSFs on a grid by a truncated singular value decomposition; bilinear between the grid's points.

        The PSFs as rows of a matrix are ``U S V^T``: the kernels are rows of V^T, the weights columns of U S. Of all
        cameras with K kernels this one has the least squared error over the grid: the sum of the squared singular
        values that are left out.

        Args:
            psfs: (rows, columns, C, h, w); the first is at the scene's upper left corner.
            scene_size: height and width of scenes.
            rank: number of kernels K; by default the rank of the matrix, which is exact.
            size: height and width of the sensor; the scene's unless given.

        Raises:
            ParameterError: `rank` is below 1.
            ShapeError: ``psfs`` has other axes.
        """
        if psfs.ndim != 5:
            raise ShapeError(
                f"`psfs` {tuple(psfs.shape)} must be (rows, columns, C, h, w), as `field_psfs` returns them. For grey "
                "ones: `psfs[:, :, None]`."
            )
        if rank is not None:
            check_at_least(1, rank=rank)
        rows, columns, *shape = psfs.shape
        left, values, right = torch.linalg.svd(psfs.reshape(rows * columns, -1), full_matrices=False)
        kept = min(rank or max(1, int((values > 1e-6 * values[0]).sum())), len(values))  # 1 of PSFs without light
        coefficients = (left[:, :kept] * values[:kept]).T.reshape(kept, 1, rows, columns)
        weights = F.interpolate(coefficients, scene_size, mode="bilinear", align_corners=True)
        lost = float(values[kept:].norm() / values.norm().clamp(min=1e-30))
        return cls(right[:kept].reshape(kept, *shape), weights, size, truncation=lost)

    @property
    def rank(self) -> int:
        """Number of kernels."""
        return self.kernels.shape[0]

    @property
    def scene_size(self) -> Size:
        """Height and width of scenes."""
        return size_of(self.weights)

    @property
    def sensor_size(self) -> Size:
        """Height and width of a measurement."""
        return self.size or self.scene_size

    def psf_at(self, row: int, column: int) -> Psf:
        """PSF (1, C, h, w) of the point at a scene pixel, centred like the PSF on the axis."""
        return (self.weights[:, :, row, column][..., None, None] * self.kernels).sum(0, keepdim=True)

    def forward(self, scene: Scene) -> Measurement:
        """Light on the sensor.

        Raises:
            ShapeError: the scene does not have `scene_size`.
            ParameterError: it is no tensor of floats.
        """
        check_batch(scene, "scene")
        if size_of(scene) != self.scene_size:
            raise ShapeError(
                f"`scene` {tuple(scene.shape)} must have the camera's scene size {self.scene_size}. "
                "Make the camera for this size: `FieldCamera.from_psfs(psfs, scene_size)`."
            )
        parts = (convolve(scene * w, h[None], size=self.sensor_size) for h, w in self._terms())
        return torch.stack(list(parts)).sum(0)

    def __call__(self, scene: Scene) -> Measurement:
        """The same as `forward`."""
        return self.forward(scene)

    def adjoint(self, measurement: Measurement) -> Scene:
        """Exact adjoint of `forward`.

        Raises:
            ShapeError: the measurement does not have `sensor_size`.
        """
        check_sensor_size(measurement, self.sensor_size)
        parts = (w * correlate(measurement, h[None], size=self.scene_size) for h, w in self._terms())
        return torch.stack(list(parts)).sum(0)

    def simulate(self, scene: Scene, *, generator: torch.Generator | None = None) -> Image:
        """A capture: `forward`, then the sensor. See `mwdn.Camera.simulate`."""
        return self.sensor.expose(self.forward(scene), generator=generator)

    def to(self, device: torch.device | str) -> "FieldCamera":
        """The same camera on a device."""
        return replace(self, kernels=self.kernels.to(device), weights=self.weights.to(device))

    def _terms(self) -> list[tuple[Tensor, Tensor]]:
        return list(zip(self.kernels, self.weights, strict=True))


def two_depths(near: FieldCamera, far: FieldCamera, is_near: Tensor) -> FieldCamera:
    """Combine two cameras into one, for a scene whose points are at one of two distances.

    At a distance z the PSF is magnified by 1 + d / z, with d from the mask to the sensor.

    Args:
        near: camera for the near points.
        far: camera for the others, of the same sizes.
        is_near: (1, 1, H, W) of the scene, 1 at near points and 0 at far ones.
    """
    weights = torch.cat([near.weights * is_near, far.weights * (1 - is_near)])
    return FieldCamera(torch.cat([near.kernels, far.kernels]), weights, near.size, near.sensor)


def gaussian_blur(image: Image, sigma: float) -> Image:
    """Blur pictures by a Gaussian of standard deviation ``sigma`` in pixels; zeros beyond their border."""
    size = size_of(image)
    # Padding by four standard deviations: 6e-5 of the light at a border wraps around to the opposite one.
    margin = math.ceil(4 * sigma)
    grid = fast_length(size[0] + margin), fast_length(size[1] + margin)
    transfer = gaussian_transfer(grid, sigma, device=image.device)
    return inverse_spectrum(spectrum(image, grid) * transfer, grid, size)
