"""How far a pattern is displaced from another of the same camera."""

from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import check_batch
from mwdn.fourier.transforms import fast_length, inverse_spectrum, spectrum
from mwdn.types import Psf


class Displacement(NamedTuple):
    """Where one pattern lies relative to another.

    Args:
        down: in pixels, to a tenth of one.
        right: likewise.
        correlation: peak of the normalised cross-correlation of the channels' means, each less its mean.
    """

    down: float
    right: float
    correlation: float


def displacement(image: Psf, reference: Psf) -> Displacement:
    """Find the displacement of an image from a reference of the same size by the peak of their cross-correlation.

    A parabola through the peak and its neighbours gives fractions of a pixel.

    Args:
        image: (1, C, H, W).
        reference: (1, C, H, W).

    Raises:
        ShapeError: other axes.
        ParameterError: no tensors of floats.
    """
    check_batch(image, "image")
    check_batch(reference, "reference")
    planes = [one.mean((0, 1)) - one.mean() for one in (image, reference)]
    grid = fast_length(2 * image.shape[-2]), fast_length(2 * image.shape[-1])
    first, second = (spectrum(plane[None, None], grid) for plane in planes)
    surface = inverse_spectrum(first * second.conj(), grid, grid)[0, 0]
    row, column = divmod(int(surface.argmax()), grid[1])
    correlation = float(surface[row, column] / (planes[0].norm() * planes[1].norm()).clamp(min=1e-30))
    down = row + _vertex(surface[:, column], row)
    right = column + _vertex(surface[row], column)
    return Displacement(_signed(down, grid[0]), _signed(right, grid[1]), correlation)


def _vertex(values: Tensor, peak: int) -> float:
    """Place of the maximum of the parabola through three values, relative to the middle one: -0.5 to 0.5."""
    before, middle, after = (float(values[(peak + step) % len(values)]) for step in (-1, 0, 1))
    curvature = before - 2 * middle + after
    return 0.0 if curvature >= 0 else 0.5 * (before - after) / curvature


def _signed(place: float, length: int) -> float:
    return place - length if place > length / 2 else place


def shifted(image: Tensor, down: int, right: int) -> Tensor:
    """Shift (..., H, W) by whole pixels; darkness enters at the border."""
    height, width = image.shape[-2:]
    moved = torch.zeros_like(image)
    if abs(down) >= height or abs(right) >= width:
        return moved
    rows, columns = (
        (slice(max(s, 0), n + min(s, 0)), slice(max(-s, 0), n - max(s, 0))) for s, n in ((down, height), (right, width))
    )
    moved[..., rows[0], columns[0]] = image[..., rows[1], columns[1]]
    return moved
