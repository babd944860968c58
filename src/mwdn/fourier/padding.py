"""Boundary handling: the values of an image beyond its border while it is filtered."""

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.errors import ParameterError, ShapeError
from mwdn.types import Image, Size, size_of

Boundary = Literal["circular", "zero", "replicate", "taper"]
"""Values beyond the measurement's border while it is deconvolved.

- ``circular``: the opposite border. No padding: the form of the MWDN authors' code.
- ``zero``: zeros.
- ``replicate``: the border's own values, repeated.
- ``taper``: the same, fading to zero, so that the image is continuous across the grid's ends.
"""


def pad(image: Image, grid: Size, boundary: Boundary) -> Tensor:
    """Pad an image to ``grid``, after its last row and column.

    On a periodic grid "after the last" is also "before the first": the first half of the new pixels continues the
    far border, the second half the near one.

    Args:
        image: (B, C, H, W).
        grid: (height, width), at least (H, W).
        boundary: values of the new pixels, see `Boundary`; ``circular`` returns the image as it is.

    Raises:
        ShapeError, ParameterError: as for `check_grid`.
    """
    size = size_of(image)
    check_grid(size, grid, boundary)
    if size == grid or boundary == "circular":
        return image
    if boundary == "zero":
        return F.pad(image, (0, grid[1] - size[1], 0, grid[0] - size[0]))
    for axis, column in ((-2, True), (-1, False)):
        far, near = border_weights(size[axis], grid[axis], boundary, image, column=column)
        last, first = image.narrow(axis, size[axis] - 1, 1), image.narrow(axis, 0, 1)
        image = torch.cat([image, last * far, first * near], dim=axis)
    return image


def check_grid(size: Size, grid: Size, boundary: Boundary) -> None:
    """Raise an error unless the boundary is known and the image fits on the grid.

    Raises:
        ParameterError: there is no such boundary.
        ShapeError: the grid is smaller than the image.
    """
    if boundary not in ("circular", "zero", "replicate", "taper"):
        raise ParameterError(f"`boundary` must be circular, zero, replicate or taper, not {boundary!r}.")
    if grid[0] < size[0] or grid[1] < size[1]:
        raise ShapeError(f"`grid` {grid} must not be smaller than the image ({size[0]} x {size[1]}).")


def border_weights(
    length: int, padded: int, boundary: Boundary, like: Tensor, *, column: bool
) -> tuple[Tensor, Tensor]:
    """Factors on the far and on the near border's value in the new pixels of one axis.

    Args:
        length: of the axis.
        padded: its length after padding.
        boundary: replicate (all factors 1) or taper.
        like: a tensor of the device and the precision to use.
        column: return columns (n, 1), for the rows of an image, instead of (n,).
    """
    count = padded - length
    position = torch.arange(count, device=like.device)
    far = (count + 1) // 2
    weights = torch.ones(count, device=like.device)
    if boundary == "taper":
        # A raised cosine: 1 next to either border, 0 in the middle of the padding.
        distance = torch.where(position < far, position + 1, count - position) / (count / 2 + 1)
        weights = 0.5 + 0.5 * torch.cos(torch.pi * distance)
    weights = weights.to(like.dtype)[:, None] if column else weights.to(like.dtype)
    return weights[:far], weights[far:]
