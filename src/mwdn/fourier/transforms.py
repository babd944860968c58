"""Fourier transforms of real images: grids, spectra, transfer functions.

The only file that calls ``torch.fft``. Everything is computed in float32, also under autocast: half-precision
transforms do not exist on CPUs, and on any device they lose the small values of a spectrum.

A PSF is centred at ``(height // 2, width // 2)``; `transfer_function` moves its centre to the origin.
"""

import math
from functools import cache

import torch
from torch import Tensor

from mwdn.errors import ShapeError
from mwdn.types import Image, Psf, Size, Spectrum


@cache
def fast_length(length: int) -> int:
    """Smallest even number, 2 or more, of at least ``length`` with no prime factor above 7: fast to transform."""
    candidate = max(2, length + length % 2)
    while True:
        factor = candidate
        for prime in (2, 3, 5, 7):
            while factor % prime == 0:
                factor //= prime
        if factor == 1:
            return candidate
        candidate += 2


def frequency_grid(grid: Size, *, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
    """Frequencies of the rows (H, 1) and the columns (1, W // 2 + 1) of a `spectrum`, in cycles per pixel."""
    rows = torch.fft.fftfreq(grid[0], device=device, dtype=torch.float32)[:, None]
    return rows, torch.fft.rfftfreq(grid[1], device=device, dtype=torch.float32)[None]


def column_counts(width: int, *, device: torch.device | str | None = None) -> Tensor:
    """Columns of the whole spectrum that each column of a `spectrum` stands for: 2, or 1 where it is its own mirror."""
    counts = torch.full((width // 2 + 1,), 2.0, device=device, dtype=torch.float32)
    counts[0] = 1
    if width % 2 == 0:
        counts[-1] = 1
    return counts


def gaussian_transfer(grid: Size, sigma: float, *, device: torch.device | str | None = None) -> Tensor:
    """Transfer function of a blur by a Gaussian of standard deviation ``sigma`` in pixels."""
    rows, columns = frequency_grid(grid, device=device)
    return torch.exp(-2 * math.pi**2 * sigma**2 * (rows.square() + columns.square()))


def spectrum(image: Tensor, grid: Size) -> Spectrum:
    """Half spectrum of a real image, zero-padded at the bottom and the right to ``grid``."""
    # Rows first: rows of padding are never transformed, and every spectrum has the same memory layout.
    rows = torch.fft.rfft(image.float(), n=grid[1])
    return torch.fft.fft(rows, n=grid[0], dim=-2)


def plane_spectrum(planes: Tensor, grid: Size) -> Spectrum:
    """`spectrum` in one call of the FFT: faster where there is little padding."""
    return torch.fft.rfft2(planes.float(), s=grid)


def inverse_spectrum(spectrum: Tensor, grid: Size, size: Size) -> Image:
    """Inverse of `spectrum`: the top left ``size`` of the image on ``grid``."""
    rows = torch.fft.ifft(spectrum, dim=-2)[..., : size[0], :]
    rows = rows.contiguous()  # MKL is 1.5 times as slow with strided rows
    return torch.fft.irfft(rows, n=grid[1])[..., : size[1]]


def frequencies(length: int) -> Tensor:
    """Frequencies of a transform of this length in cycles per sample, float64, origin first."""
    return torch.fft.fftfreq(length, dtype=torch.float64)


def filter_field(field: Tensor, transfer: Tensor) -> Tensor:
    """Multiply the spectrum of a complex field, zero-padded at the bottom and the right, with a transfer function.

    Args:
        field: complex, (..., H, W), at most as large as ``transfer``.
        transfer: complex, whole spectrum of the grid, origin first.
    """
    height, width = transfer.shape[-2:]
    if field.shape[-2:] == transfer.shape[-2:]:
        return torch.fft.ifft2(torch.fft.fft2(field.to(torch.complex64)).mul_(transfer))
    # Rows first and columns last, so that rows of padding are never transformed.
    rows = torch.fft.fft(field.to(torch.complex64), n=width)
    return torch.fft.ifft2(torch.fft.fft(rows, n=height, dim=-2).mul_(transfer))


def transfer_function(psf: Psf, grid: Size, origin: Size | None = None) -> Spectrum:
    """Spectrum of a PSF whose pixel ``origin`` is moved to (0, 0).

    Args:
        psf: (B, C, h, w), at most as large as ``grid``.
        grid: height and width of the transform.
        origin: the pixel of zero displacement; by default the centre ``(h // 2, w // 2)``.

    Raises:
        ShapeError: the PSF is larger than the grid.
    """
    height, width = psf.shape[-2:]
    if height > grid[0] or width > grid[1]:
        raise ShapeError(
            f"`psf` ({height} x {width}) must not be larger than the grid ({grid[0]} x {grid[1]}). Crop it about its "
            "centre to the size of the measurement."
        )
    row, column = (height // 2, width // 2) if origin is None else origin
    padded = torch.nn.functional.pad(psf.float().contiguous(), (0, grid[1] - width, 0, grid[0] - height))
    return spectrum(padded.roll((-row, -column), dims=(-2, -1)), grid)
