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
    """`extend` of planes (B, C, H, W) into fresh float32 memory, and its adjoint: the same numbers, fewer copies.

    What is `paired` becomes complex planes.
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


def together(planes: Tensor, grid: Size) -> Iterator[tuple[slice, slice]]:
    """Samples and channels (or pairs) transformed together: four megabytes on a CPU, at most a gigabyte on a GPU."""
    samples, channels = planes.shape[:2]
    numbers = grid[0] * grid[1] * (planes.ndim - 3)  # of a pair twice as many
    alone = planes.device.type == "cpu"
    step = max(1, (2**20 if alone else 2**28) // numbers)
    many = 1 if alone else max(1, step // channels)
    for sample in range(0, samples, many):
        for first in range(0, channels, step):
            yield slice(sample, sample + many), slice(first, first + step)


LARGEST = 2**26
"""Numbers of a picture that are laid out anew at once."""


def in_parts(
    function: Callable[[Tensor, Tensor], Tensor], image: Tensor, other: Tensor, step: int | None = None
) -> Tensor:
    """``function(image, other)`` of (B, C, H, W) and (B, 1 or C, ...), ``step`` channels at a time.

    Unless given, these are all, and of a large picture a few: an even number, which can be `paired`.
    """
    step = step or max(2, LARGEST // max(1, image[:, :1].numel()) // 2 * 2)
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
    result = torch.empty(image.shape, dtype=image.dtype, device=image.device)
    _transpose(_pixels(image), result.flatten(2))
    return result


def laid_out_as(image: Tensor, planes: Tensor) -> Tensor:
    """The planes in the memory format of ``image``, which has their shape."""
    if image.is_contiguous() or not image.is_contiguous(memory_format=torch.channels_last):
        return planes
    result = torch.empty_like(planes, memory_format=torch.channels_last)
    _transpose(planes.flatten(2), _pixels(result))
    return result


def paired(image: Tensor) -> Tensor:
    """Each two channels as the real and the imaginary part of one plane: (B, C, H, W) to (B, C / 2, H, W, 2).

    Where channels lie side by side, two are moved as one number: half the work of `planar`.
    """
    if image.stride(1) != 1:
        return image.unflatten(1, (-1, 2)).movedim(2, -1)  # type: ignore[no-untyped-call]
    batch, channels, height, width = image.shape
    result = torch.empty((batch, channels // 2, height, width, 2), dtype=image.dtype, device=image.device)
    _transpose(_two_as_one(_pixels(image)), _two_as_one(result.flatten(2)))
    return result


def unpaired(pairs: Tensor, image: Tensor) -> Tensor:
    """The channels that were `paired`, in the memory format of ``image``, which has their shape."""
    if image.is_contiguous() or not image.is_contiguous(memory_format=torch.channels_last):
        return pairs.movedim(-1, 2).flatten(1, 2)
    result = torch.empty_like(image)
    _transpose(_two_as_one(pairs.flatten(2)), _two_as_one(_pixels(result)))
    return result


def folded(image: Tensor, block: int) -> Tensor:
    """`torch.nn.functional.pixel_unshuffle`, channels-last: each ``block`` x ``block`` pixels as one of more channels.

    Where blocks are pairs of pairs and no gradient is asked for, each pair is moved as one number: a third of the time.
    """
    if block != 2 or not image.is_contiguous() or image.requires_grad or torch.compiler.is_exporting():
        channels_last = image.contiguous(memory_format=torch.channels_last)
        return F.pixel_unshuffle(channels_last, block).contiguous(memory_format=torch.channels_last)
    rows = _two_as_one(image).unflatten(2, (-1, 2))  # type: ignore[no-untyped-call]
    return rows.permute(0, 2, 4, 1, 3).contiguous().view(image.dtype).flatten(3).movedim(-1, 1)


def _pixels(image: Tensor) -> Tensor:
    """(B, H W, C), the channels of a pixel side by side; a part of more channels is gathered first."""
    return image.contiguous(memory_format=torch.channels_last).movedim(1, -1).flatten(1, 2)


def _two_as_one(numbers: Tensor) -> Tensor:
    """Each two numbers that lie side by side as one, whatever that is."""
    return numbers.view({2: torch.int32, 4: torch.int64}[numbers.itemsize])


def _transpose(source: Tensor, target: Tensor) -> None:
    """Matrix by matrix: on a CPU torch is then thrice as fast as with its copy of a channels-last picture."""
    if source.device.type != "cpu":
        target.copy_(source.mT)
        return
    for each, transposed in zip(source, target, strict=True):
        transposed.copy_(each.t())
