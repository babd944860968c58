"""Linear and circular convolution of a scene with a PSF, and its adjoint."""

from typing import NamedTuple

from torch import Tensor

from mwdn.arguments import check_batch, checked
from mwdn.errors import ShapeError
from mwdn.fourier.transforms import fast_length, inverse_spectrum, spectrum, transfer_function
from mwdn.types import Image, Measurement, Psf, Scene, Size, Spectrum, size_of


def _operator(psf: Tensor, scene: Size, sensor: Size, *, circular: bool) -> tuple[Spectrum, Size]:
    """Transfer function and its grid, for a scene and a sensor stored at (0, 0) whose centres are aligned.

    The wrap-around of the full convolution must not reach the sensor. With the lengths s, o and p of scene, sensor and
    PSF, counted from the centres, the sensor is [-(o//2), o-o//2-1] and the full convolution
    [-(s//2+p//2), (s-s//2-1)+(p-p//2-1)]. So the grid needs 1 + the larger of the two overhangs: 1.5 n for equal sizes
    n, where 2 n is the usual choice.
    """
    if min(*scene, *sensor) < 1:
        raise ShapeError(f"`size` {min(scene, sensor, key=min)} must be positive: height and width in pixels.")
    grid, origin = [], []
    for s, o, p in zip(scene, sensor, psf.shape[-2:], strict=True):
        before = s // 2 + p // 2 + (o - o // 2 - 1)
        after = (s - s // 2 - 1) + (p - p // 2 - 1) + o // 2
        grid.append(max(s, o) if circular else fast_length(max(1 + before, 1 + after, s, o, p)))
        origin.append(p // 2 + s // 2 - o // 2)
    size = (grid[0], grid[1])
    return transfer_function(psf, size, (origin[0], origin[1])), size


def check_fit(image: Tensor, psf: Tensor, name: str) -> None:
    """Raise a `ShapeError` unless the PSF's batch and channels are 1 or those of the image called ``name``.

    Neither may be empty: FFTs of nothing fail in the libraries.
    """
    check_batch(image, name)
    check_batch(psf, "psf")
    if 0 in (*image.shape, *psf.shape):
        raise ShapeError(
            f"`{name}` {tuple(image.shape)} and `psf` {tuple(psf.shape)} must be non-empty batches (B, C, H, W)."
        )
    for axis, dimension, way_out in (
        (0, "samples", "For one PSF: `psf[:1]`."),
        (1, "channels", "Average it: `psf.mean(1, keepdim=True)`."),
    ):
        if psf.shape[axis] not in (1, image.shape[axis]):
            raise ShapeError(
                f"`psf` {tuple(psf.shape)} has {psf.shape[axis]} {dimension} and `{name}` {tuple(image.shape)} has "
                f"{image.shape[axis]}: they must be equal, or the PSF must have 1. {way_out}"
            )


@checked
def convolve(scene: Scene, psf: Psf, *, size: Size | None = None, circular: bool = False) -> Image:
    """Convolution of a scene with a PSF, on a sensor of ``size`` whose centre is aligned with the scene's.

    Args:
        scene: (B, C, H, W).
        psf: (1 or B, 1 or C, h, w), centred at ``(h // 2, w // 2)``.
        size: height and width of the result; by default the scene's. A smaller one crops, as a sensor does.
        circular: wrap around: what leaves at one border enters at the opposite one.

    Returns:
        (B, C, *size), float32.

    Raises:
        ShapeError: batch, channels or (circular only) sizes do not fit, one is empty, or ``size`` is not positive.

    References:
        Eq. (1) of the MWDN paper, without the noise.
    """
    check_fit(scene, psf, "scene")
    size = size or size_of(scene)
    transfer, grid = _operator(psf, size_of(scene), size, circular=circular)
    return inverse_spectrum(spectrum(scene, grid) * transfer, grid, size)


@checked
def correlate(measurement: Measurement, psf: Psf, *, size: Size | None = None, circular: bool = False) -> Scene:
    """Exact adjoint of `convolve`: ``<convolve(v, psf), b> == <v, correlate(b, psf)>``.

    Args:
        measurement: (B, C, H, W).
        psf: as for `convolve`.
        size: height and width of the scene; by default the measurement's.
        circular: as for `convolve`.

    Returns:
        (B, C, *size), float32.

    Raises:
        ShapeError: as for `convolve`.
    """
    check_fit(measurement, psf, "measurement")
    size = size or size_of(measurement)
    transfer, grid = _operator(psf, size, size_of(measurement), circular=circular)
    return inverse_spectrum(spectrum(measurement, grid) * transfer.conj(), grid, size)


class Convolution(NamedTuple):
    """`convolve` and `correlate` between fixed sizes, for iterations: the PSF is transformed once."""

    transfer: Spectrum
    grid: Size
    scene: Size
    sensor: Size

    @classmethod
    def from_psf(cls, psf: Psf, scene: Size, sensor: Size) -> "Convolution":
        """Transform a PSF for linear convolutions of scenes."""
        transfer, grid = _operator(psf, scene, sensor, circular=False)
        return cls(transfer, grid, scene, sensor)

    @classmethod
    def from_transfer(cls, transfer: Spectrum, scene: Size, sensor: Size) -> "Convolution":
        """Reuse the transfer function of another `Convolution` between the same sizes."""
        return cls(transfer, (transfer.shape[-2], 2 * (transfer.shape[-1] - 1)), scene, sensor)  # its grid is even

    def forward(self, scene: Scene) -> Image:
        """Convolve a scene and crop it to the sensor.

        Raises:
            ShapeError: the scene has another size.
        """
        _check_size(scene, self.scene, "scene")
        return inverse_spectrum(spectrum(scene, self.grid) * self.transfer, self.grid, self.sensor)

    def adjoint(self, measurement: Measurement) -> Scene:
        """Exact adjoint of `forward`.

        Raises:
            ShapeError: the measurement has another size.
        """
        _check_size(measurement, self.sensor, "measurement")
        return inverse_spectrum(spectrum(measurement, self.grid) * self.transfer.conj(), self.grid, self.scene)


def _check_size(image: Tensor, size: Size, name: str) -> None:
    if tuple(image.shape[-2:]) != tuple(size):  # a transform would crop it, or pad it
        raise ShapeError(f"`{name}` {tuple(image.shape)} must have the size {tuple(size)} of this `Convolution`.")
