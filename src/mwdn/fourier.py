"""Convolution and correlation by fast Fourier transforms; `mwdn.deconvolution` goes the other way.

The only file that calls ``torch.fft``. Everything here is computed in float32, whatever the autocast state, because
half-precision transforms do not exist on CPUs and lose the small values of a spectrum everywhere.

A PSF enters centred at ``(height // 2, width // 2)``; the shift to the origin happens here and nowhere else.
"""

import math
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import ShapeError
from mwdn.planes import Size as Size
from mwdn.types import Image, Measurement, Psf, Scene, Spectrum


@cache
def fast_length(length: int) -> int:
    """Smallest even number of at least ``length`` with no prime factor above 7, quick to transform."""
    candidate = length + length % 2
    while True:
        rest = candidate
        for prime in (2, 3, 5, 7):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return candidate
        candidate += 2


def frequency_grid(grid: Size, *, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
    """Frequencies of a `spectrum`'s rows, (H, 1), and columns, (1, W // 2 + 1), in cycles per pixel."""
    rows = torch.fft.fftfreq(grid[0], device=device)[:, None]
    return rows, torch.fft.rfftfreq(grid[1], device=device)[None]


def gaussian_transfer(grid: Size, sigma: float, *, device: torch.device | str | None = None) -> Tensor:
    """What a blur by a Gaussian of standard deviation ``sigma`` in pixels multiplies a `spectrum` with."""
    rows, columns = frequency_grid(grid, device=device)
    return torch.exp(-2 * math.pi**2 * sigma**2 * (rows.square() + columns.square()))


def spectrum(image: Tensor, grid: Size) -> Spectrum:
    """Real Fourier transform of a picture, zero-padded at the bottom and the right to ``grid``."""
    # Rows first: those which are only padding are never transformed, and every spectrum lies in memory alike.
    rows = torch.fft.rfft(image.float(), n=grid[1])
    return torch.fft.fft(rows, n=grid[0], dim=-2)


def plane_spectrum(planes: Tensor, grid: Size) -> Spectrum:
    """The same in one call, quicker where little is padded."""
    return torch.fft.rfft2(planes.float(), s=grid)


def inverse_spectrum(spectrum: Tensor, grid: Size, size: Size) -> Image:
    """Top left ``size`` of the picture on ``grid`` that has this spectrum."""
    rows = torch.fft.ifft(spectrum, dim=-2)[..., : size[0], :]
    rows = rows.contiguous()  # MKL takes half as long again for rows that it must gather itself
    return torch.fft.irfft(rows, n=grid[1])[..., : size[1]]


def frequencies(length: int) -> Tensor:
    """Frequencies of a grid's transform in cycles a sample, float64, origin first."""
    return torch.fft.fftfreq(length, dtype=torch.float64)


def filter_field(field: Tensor, transfer: Tensor) -> Tensor:
    """Multiply the spectrum of a complex field, zero-padded at the bottom and the right, with a transfer function.

    Args:
        field: complex, (..., H, W), at most as large as ``transfer``.
        transfer: complex, of the whole grid, origin first.
    """
    height, width = transfer.shape[-2:]
    if field.shape[-2:] == transfer.shape[-2:]:
        return torch.fft.ifft2(torch.fft.fft2(field.to(torch.complex64)).mul_(transfer))
    # Rows first and columns last, so that rows which are only padding are never transformed.
    rows = torch.fft.fft(field.to(torch.complex64), n=width)
    return torch.fft.ifft2(torch.fft.fft(rows, n=height, dim=-2).mul_(transfer))


def transfer_function(psf: Psf, grid: Size, origin: Size | None = None) -> Spectrum:
    """Spectrum of a PSF whose pixel ``origin`` is moved to (0, 0).

    Args:
        psf: (B, C, h, w), at most as large as ``grid``.
        grid: the size to transform at.
        origin: the pixel that stands for "no displacement"; the centre ``(h // 2, w // 2)`` unless given.
    """
    height, width = psf.shape[-2:]
    if height > grid[0] or width > grid[1]:
        raise ShapeError(f"`psf` ({height} x {width}) must not be larger than the grid ({grid[0]} x {grid[1]}).")
    row, column = (height // 2, width // 2) if origin is None else origin
    padded = torch.nn.functional.pad(psf.float().contiguous(), (0, grid[1] - width, 0, grid[0] - height))
    return spectrum(padded.roll((-row, -column), dims=(-2, -1)), grid)


def _operator(psf: Tensor, scene: Size, sensor: Size, *, circular: bool) -> tuple[Spectrum, Size]:
    """Transfer function that takes a scene at (0, 0) to a sensor at (0, 0), their centres aligned; and its grid.

    The grid must be so long that no wrapped end of the full convolution lands on the sensor. Counted from the
    centres, the sensor is [-(o//2), o-o//2-1] and the full convolution [-(s//2+p//2), (s-s//2-1)+(p-p//2-1)], so
    the grid needs 1 + the larger of the two overhangs: 1.5 n for equal sizes n, where 2 n is the usual choice.
    """
    grid, origin = [], []
    for s, o, p in zip(scene, sensor, psf.shape[-2:], strict=True):
        before = s // 2 + p // 2 + (o - o // 2 - 1)
        after = (s - s // 2 - 1) + (p - p // 2 - 1) + o // 2
        grid.append(max(s, o) if circular else fast_length(max(1 + before, 1 + after, s, o, p)))
        origin.append(p // 2 + s // 2 - o // 2)
    size = (grid[0], grid[1])
    return transfer_function(psf, size, (origin[0], origin[1])), size


def check_fit(image: Tensor, psf: Tensor, name: str) -> None:
    """Raise a `ShapeError` unless the PSF's batch and channels are 1 or those of the picture called ``name``."""
    for axis, of in ((0, "batch"), (1, "channels")):
        if psf.shape[axis] not in (1, image.shape[axis]):
            raise ShapeError(f"`psf` {tuple(psf.shape)} must have {of} 1 or that of `{name}` {tuple(image.shape)}.")


def convolve(scene: Scene, psf: Psf, *, size: Size | None = None, circular: bool = False) -> Image:
    """Convolution of a scene with a PSF, as seen by a sensor of ``size`` whose centre faces the scene's centre.

    Args:
        scene: (B, C, H, W).
        psf: (1 or B, 1 or C, h, w), centred at ``(h // 2, w // 2)``.
        size: height and width of the result; the scene's unless given. A smaller one crops, as a sensor does.
        circular: let what leaves the scene at one border enter at the other, instead of leaving for good.

    Returns:
        (B, C, *size), float32.

    Raises:
        ShapeError: batch, channels or (circular only) sizes do not fit.

    References:
        Eq. (1) of the MWDN paper, without the noise.
    """
    check_fit(scene, psf, "scene")
    size = size or (scene.shape[-2], scene.shape[-1])
    transfer, grid = _operator(psf, (scene.shape[-2], scene.shape[-1]), size, circular=circular)
    return inverse_spectrum(spectrum(scene, grid) * transfer, grid, size)


def correlate(measurement: Measurement, psf: Psf, *, size: Size | None = None, circular: bool = False) -> Scene:
    """Exact adjoint of `convolve`: ``<convolve(v, psf), b> == <v, correlate(b, psf)>``.

    Args:
        measurement: (B, C, H, W).
        psf: as for `convolve`.
        size: height and width of the scene; the measurement's unless given.
        circular: as for `convolve`.

    Returns:
        (B, C, *size), float32.
    """
    check_fit(measurement, psf, "measurement")
    size = size or (measurement.shape[-2], measurement.shape[-1])
    transfer, grid = _operator(psf, size, (measurement.shape[-2], measurement.shape[-1]), circular=circular)
    return inverse_spectrum(spectrum(measurement, grid) * transfer.conj(), grid, size)


class Convolution(NamedTuple):
    """`convolve` and `correlate` between fixed sizes, for a method that needs both many times: see `convolution`."""

    transfer: Spectrum
    grid: Size
    scene: Size
    sensor: Size

    def forward(self, scene: Scene) -> Image:
        """What the sensor sees of a scene."""
        return inverse_spectrum(spectrum(scene, self.grid) * self.transfer, self.grid, self.sensor)

    def adjoint(self, measurement: Measurement) -> Scene:
        """Exact adjoint of `forward`."""
        return inverse_spectrum(spectrum(measurement, self.grid) * self.transfer.conj(), self.grid, self.scene)


def convolution(psf: Psf, scene: Size, sensor: Size) -> Convolution:
    """Linear convolution of scenes with a PSF that is transformed once, here."""
    transfer, grid = _operator(psf, scene, sensor, circular=False)
    return Convolution(transfer, grid, scene, sensor)
