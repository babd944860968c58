"""Fourier transforms of real pictures: grids, spectra, transfer functions.

The only file that calls ``torch.fft``. Everything is computed in float32, whatever the autocast state: half-precision
transforms do not exist on CPUs and lose the small values of a spectrum everywhere.

A PSF enters centred at ``(height // 2, width // 2)``; `transfer_function` moves its centre to the origin.
"""

import math
from functools import cache

import torch
from torch import Tensor

from mwdn.errors import ShapeError
from mwdn.types import Image, Psf, Size, Spectrum


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
