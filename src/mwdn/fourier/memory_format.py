"""Memory layout of features for convolutions and Fourier transforms.

Convolutions are fastest with the channels of a pixel side by side (channels-last), transforms with contiguous planes.
"""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.types import Size


def chunks(planes: Tensor, grid: Size) -> Iterator[tuple[slice, slice]]:
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


def chunked(
    function: Callable[[Tensor, Tensor], Tensor], image: Tensor, other: Tensor, step: int | None = None
) -> Tensor:
    """``function(image, other)`` of (B, C, H, W) and (B, 1 or C, ...), ``step`` channels at a time.

    Unless given, these are all, and of a large picture a few: an even number, which can be `as_complex`.
    """
    step = step or max(2, LARGEST // max(1, image[:, :1].numel()) // 2 * 2)
    if step >= image.shape[1]:
        return function(image, other)
    result = torch.empty_like(image)
    for first in range(0, image.shape[1], step):
        part = slice(first, first + step)
        result[:, part] = function(image[:, part], other[:, part] if other.shape[1] > 1 else other)
    return result


def contiguous_planes(image: Tensor) -> Tensor:
    """The picture with each channel's plane in one piece."""
    if image.is_contiguous() or image.stride(1) != 1:
        return image.contiguous()
    result = torch.empty(image.shape, dtype=image.dtype, device=image.device)
    _transpose(_pixels(image), result.flatten(2))
    return result


def match_format(image: Tensor, planes: Tensor) -> Tensor:
    """The planes in the memory format of ``image``, which has their shape."""
    if image.is_contiguous() or not image.is_contiguous(memory_format=torch.channels_last):
        return planes
    result = torch.empty_like(planes, memory_format=torch.channels_last)
    _transpose(planes.flatten(2), _pixels(result))
    return result


def as_complex(image: Tensor) -> Tensor:
    """Each two channels as the real and the imaginary part of one plane: (B, C, H, W) to (B, C / 2, H, W, 2).

    Where channels lie side by side, two are moved as one number: half the work of `contiguous_planes`.
    """
    if image.stride(1) != 1:
        return image.unflatten(1, (-1, 2)).movedim(2, -1)  # type: ignore[no-untyped-call]
    batch, channels, height, width = image.shape
    result = torch.empty((batch, channels // 2, height, width, 2), dtype=image.dtype, device=image.device)
    _transpose(_two_as_one(_pixels(image)), _two_as_one(result.flatten(2)))
    return result


def as_channels(pairs: Tensor, image: Tensor) -> Tensor:
    """The channels that were `as_complex`, in the memory format of ``image``, which has their shape."""
    if image.is_contiguous() or not image.is_contiguous(memory_format=torch.channels_last):
        return pairs.movedim(-1, 2).flatten(1, 2)
    result = torch.empty_like(image)
    _transpose(_two_as_one(pairs.flatten(2)), _two_as_one(_pixels(result)))
    return result


def pixel_unshuffle(image: Tensor, block: int) -> Tensor:
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
