"""What a Fourier transform asks of a picture's planes: continued beyond their borders, and one after the other.

Convolutions are fast where the channels of a pixel lie side by side (channels-last), transforms where those of a plane
do. Nothing here is transformed; that is `mwdn.fourier`.
"""

from collections.abc import Callable, Iterator
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.errors import ParameterError, ShapeError
from mwdn.types import Image

Size = tuple[int, int]
"""(height, width)"""

Boundary = Literal["circular", "zero", "replicate", "taper"]
"""What stands beyond the measurement's border while it is deconvolved.

- ``circular``: the opposite border. No padding: the form of the MWDN authors' code.
- ``zero``: darkness.
- ``replicate``: the border's own values, repeated.
- ``taper``: the same, fading to darkness, so that the opposite ends of the grid meet without a step.
"""


def extend(image: Image, grid: Size, boundary: Boundary) -> Tensor:
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


class Continuation:
    """`extend` of planes (B, C, H, W) into fresh float32 memory, and its adjoint: the same numbers, fewer copies."""

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
        if self.dark:
            return (
                F.pad(planes.float(), (0, columns - width, 0, rows - height))
                if self.size != self.grid
                else planes.float()
            )
        whole = planes.new_empty((*planes.shape[:2], rows, columns), dtype=torch.float32)
        inside, far, near = whole[..., :height, :], *self.columns
        inside[..., :width] = planes
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


def together(planes: Tensor, grid: Size) -> Iterator[tuple[slice, slice]]:
    """Samples and channels of (B, C, H, W) transformed together: a megabyte on a CPU, at most a gigabyte on a GPU."""
    samples, channels = planes.shape[:2]
    step = max(1, (2**18 if planes.device.type == "cpu" else 2**28) // (grid[0] * grid[1]))
    for sample in range(samples):
        for first in range(0, channels, step):
            yield slice(sample, sample + 1), slice(first, first + step)


LARGEST = 2**26
"""Numbers of a picture that are laid out anew at once."""


def in_parts(
    function: Callable[[Tensor, Tensor], Tensor], image: Tensor, other: Tensor, step: int | None = None
) -> Tensor:
    """``function(image, other)`` of (B, C, H, W) and (B, 1 or C, ...), ``step`` channels at a time.

    Unless given, these are all, and of a large picture a few.
    """
    step = step or max(1, LARGEST // max(1, image[:, :1].numel()))
    if step >= image.shape[1]:
        return function(image, other)
    result = torch.empty_like(image)
    for first in range(0, image.shape[1], step):
        part = slice(first, first + step)
        result[:, part] = function(image[:, part], other[:, part] if other.shape[1] > 1 else other)
    return result


def planar(image: Tensor) -> Tensor:
    """The picture with each channel's plane in one piece."""
    if image.is_contiguous() or image.stride(1) != 1:
        return image.contiguous()
    # torch has a fast transposition of matrices, thrice as fast as its copy of a channels-last picture.
    image = image.contiguous(memory_format=torch.channels_last)  # a part of more channels is gathered first
    result = torch.empty(image.shape, dtype=image.dtype, device=image.device)
    for planes, pixels in zip(result.flatten(2), image.movedim(1, -1).flatten(1, 2), strict=True):
        planes.copy_(pixels.t())
    return result


def laid_out_as(image: Tensor, planes: Tensor) -> Tensor:
    """The planes in the memory format of ``image``, which has their shape."""
    if image.is_contiguous() or not image.is_contiguous(memory_format=torch.channels_last):
        return planes
    result = torch.empty_like(planes, memory_format=torch.channels_last)
    for pixels, source in zip(result.movedim(1, -1).flatten(1, 2), planes.flatten(2), strict=True):
        pixels.copy_(source.t())
    return result
