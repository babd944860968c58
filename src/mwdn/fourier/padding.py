"""Boundary handling: how a picture continues beyond its border while it is filtered."""

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.errors import ParameterError, ShapeError
from mwdn.types import Image, Size

Boundary = Literal["circular", "zero", "replicate", "taper"]
"""What stands beyond the measurement's border while it is deconvolved.

- ``circular``: the opposite border. No padding: the form of the MWDN authors' code.
- ``zero``: darkness.
- ``replicate``: the border's own values, repeated.
- ``taper``: the same, fading to darkness, so that the opposite ends of the grid meet without a step.
"""


def pad(image: Image, grid: Size, boundary: Boundary) -> Tensor:
    """Continue a picture to ``grid``: the new pixels come after the last row and column.

    On a periodic grid "after the last" is also "before the first": the first half of the new pixels continues the
    far border, the second half the near one.
    """
    size = _checked((image.shape[-2], image.shape[-1]), grid, boundary)
    if size == grid or boundary == "circular":
        return image
    if boundary == "zero":
        return F.pad(image, (0, grid[1] - size[1], 0, grid[0] - size[0]))
    for axis, column in ((-2, True), (-1, False)):
        far, near = _fades(size[axis], grid[axis], boundary, image, column=column)
        last, first = image.narrow(axis, size[axis] - 1, 1), image.narrow(axis, 0, 1)
        image = torch.cat([image, last * far, first * near], dim=axis)
    return image


class Padding:
    """`pad` of planes (B, C, H, W) into fresh float32 memory, and its adjoint: the same numbers, fewer copies.

    What is `as_complex` becomes complex planes.
    """

    def __init__(self, size: Size, grid: Size, boundary: Boundary, like: Tensor) -> None:
        self.size, self.grid = _checked(size, grid, boundary), grid
        self.dark = size == grid or boundary in ("zero", "circular")
        single = like.new_empty(0, dtype=torch.float32)
        if not self.dark:
            self.rows = _fades(size[0], grid[0], boundary, single, column=True)
            self.columns = _fades(size[1], grid[1], boundary, single, column=False)

    def __call__(self, planes: Tensor) -> Tensor:
        """Continue the planes."""
        (height, width), (rows, columns) = self.size, self.grid
        dtype = torch.complex64 if planes.ndim == 5 else torch.float32
        whole = torch.empty((*planes.shape[:2], rows, columns), dtype=dtype, device=planes.device)
        if self.dark and self.size != self.grid:
            whole.zero_()
        inside = whole[..., :height, :]
        seen = inside[..., :width]
        (torch.view_as_real(seen) if seen.is_complex() else seen).copy_(planes)
        if self.dark:
            return whole
        far, near = self.columns
        torch.mul(inside[..., width - 1 : width], far, out=inside[..., width : width + far.numel()])
        torch.mul(inside[..., :1], near, out=inside[..., width + far.numel() :])
        far, near = self.rows
        torch.mul(whole[..., height - 1 : height, :], far, out=whole[..., height : height + far.numel(), :])
        torch.mul(whole[..., :1, :], near, out=whole[..., height + far.numel() :, :])
        return whole

    def adjoint(self, whole: Tensor) -> Tensor:
        """Add what the new pixels hold to the border pixels that they came from; ``whole`` is overwritten."""
        height, width = self.size
        if not self.dark:
            far, near = self.rows
            whole[..., height - 1, :] += (whole[..., height : height + far.numel(), :] * far).sum(-2)
            whole[..., 0, :] += (whole[..., height + far.numel() :, :] * near).sum(-2)
            far, near = self.columns
            inside = whole[..., :height, :]
            inside[..., width - 1] += (inside[..., width : width + far.numel()] * far).sum(-1)
            inside[..., 0] += (inside[..., width + far.numel() :] * near).sum(-1)
        return whole[..., :height, :width]


def _checked(size: Size, grid: Size, boundary: Boundary) -> Size:
    if boundary not in ("circular", "zero", "replicate", "taper"):
        raise ParameterError(f"`boundary` must be circular, zero, replicate or taper, not {boundary!r}.")
    if grid[0] < size[0] or grid[1] < size[1]:
        raise ShapeError(f"`grid` {grid} must not be smaller than the picture ({size[0]} x {size[1]}).")
    return size


def _fades(length: int, whole: int, boundary: Boundary, like: Tensor, *, column: bool) -> tuple[Tensor, Tensor]:
    """What is left of the far border's value, and of the near one's, in the new pixels that continue them."""
    more = whole - length
    position = torch.arange(more, device=like.device)
    count = (more + 1) // 2
    fades = torch.ones(more, device=like.device)
    if boundary == "taper":
        # A raised cosine: 1 next to either border, 0 in the middle of the padding.
        distance = torch.where(position < count, position + 1, more - position) / (more / 2 + 1)
        fades = 0.5 + 0.5 * torch.cos(torch.pi * distance)
    fades = fades.to(like.dtype)[:, None] if column else fades.to(like.dtype)
    return fades[:count], fades[count:]
