"""How far a pattern is displaced from another of the same camera, and how alike the two are."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.arguments import check_batch
from mwdn.errors import ShapeError
from mwdn.fourier.transforms import column_counts, fast_length, frequency_grid, inverse_spectrum, spectrum
from mwdn.types import Psf, Size, Spectrum

PEAK_STEPS_PX = (0.1, 0.01)
"""Steps in pixels by which the peak is refined, each from -10 to 10."""


class Displacement(NamedTuple):
    """Where one pattern lies relative to another.

    Args:
        down: in pixels, to a hundredth of one.
        right: likewise.
        correlation: peak of the normalised cross-correlation of the channels' means, each less its mean.
    """

    down: float
    right: float
    correlation: float


def displacement(image: Psf, reference: Psf) -> Displacement:
    """Find the displacement of an image from a reference of the same size by the peak of their cross-correlation.

    The peak is searched between the pixels, where the band-limited correlation is computed from its spectrum. The lines
    of a PSF are one or two pixels wide, so half a pixel beside the peak the correlation is already 5 % lower or more.

    Args:
        image: (1, C, H, W).
        reference: (1, C, H, W).

    Raises:
        ShapeError: the axes or sizes do not fit.
        ParameterError: not tensors of floats.

    References:
        M. Guizar-Sicairos et al., Opt. Lett. 33, 156 (2008), for the refinement.
    """
    check_batch(image, "image")
    check_batch(reference, "reference")
    if image.shape[-2:] != reference.shape[-2:]:
        raise ShapeError(
            f"`image` {tuple(image.shape)} and `reference` {tuple(reference.shape)} must have the same height and "
            "width."
        )
    planes = [one.mean((0, 1)) - one.mean() for one in (image, reference)]
    grid = fast_length(2 * image.shape[-2]), fast_length(2 * image.shape[-1])
    first, second = (spectrum(plane[None, None], grid) for plane in planes)
    product = first * second.conj()
    surface = inverse_spectrum(product, grid, grid)[0, 0]
    down, right = (float(place) for place in divmod(int(surface.argmax()), grid[1]))
    peak = float(surface.max())
    for step in PEAK_STEPS_PX:
        around = step * torch.arange(-10, 11, dtype=torch.float64)
        values = _between_pixels(product, grid, down + around, right + around)
        row, column = divmod(int(values.argmax()), len(around))
        down, right, peak = down + float(around[row]), right + float(around[column]), float(values.max())
    energy = math.prod(float(plane.double().norm()) for plane in planes)
    return Displacement(_signed(down, grid[0]), _signed(right, grid[1]), peak / max(energy, 1e-30))


def _between_pixels(product: Spectrum, grid: Size, rows: Tensor, columns: Tensor) -> Tensor:
    """Values (rows, columns) at fractional places of the image (1, 1, *grid) with this spectrum.

    The inverse transform is computed at these places only, as two matrix products.
    """
    vertical, horizontal = (each.double() for each in frequency_grid(grid, device=product.device))
    counts = column_counts(grid[1], device=product.device)[:, None]
    phase_rows = torch.exp(2j * math.pi * rows[:, None].to(product.device) * vertical.T)
    phase_columns = counts * torch.exp(2j * math.pi * horizontal.T * columns[None].to(product.device))
    return (phase_rows @ product[0, 0].to(torch.complex128) @ phase_columns).real / (grid[0] * grid[1])


def _signed(place: float, length: int) -> float:
    return place - length if place > length / 2 else place


def shifted(image: Tensor, down: int, right: int) -> Tensor:
    """Shift (..., H, W) by whole pixels; zeros enter at the border."""
    height, width = image.shape[-2:]
    moved = torch.zeros_like(image)
    if abs(down) >= height or abs(right) >= width:
        return moved
    rows, columns = (
        (slice(max(s, 0), n + min(s, 0)), slice(max(-s, 0), n - max(s, 0))) for s, n in ((down, height), (right, width))
    )
    moved[..., rows[0], columns[0]] = image[..., rows[1], columns[1]]
    return moved
