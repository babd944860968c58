"""What happens to every frame of a sensor, a PSF's or a capture's: levels, crop, binning."""

from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from mwdn.errors import ParameterError, ShapeError, UnknownNameError
from mwdn.types import Frame, Image, Size

Mosaic = Literal["rggb", "bggr", "grbg", "gbrg"]
"""Colour filter arrays: the colours of 2 x 2 cells, row by row."""

Background = float | Literal["estimate"]
"""A level as a part of the full scale, or ``"estimate"``."""


def full_scale(frame: Frame, bit_depth: int | None) -> float:
    """Largest number that the sensor can give: ``2^bit_depth - 1``, the file's type, or 1 for floats.

    Raises:
        ParameterError: a number of the frame is larger, or the file's type holds fewer bits.
    """
    if bit_depth is None:
        return 1.0 if frame.dtype.kind == "f" else float(np.iinfo(frame.dtype).max)
    if not 1 <= bit_depth <= 16:
        raise ParameterError(f"`bit_depth` ({bit_depth}) must be 1 to 16.")
    if frame.dtype.kind != "f" and bit_depth > 8 * frame.dtype.itemsize:
        raise ParameterError(
            f"`bit_depth` ({bit_depth}) must be at most {8 * frame.dtype.itemsize}, the bits of the file's numbers. "
            "Save frames with 16 bits, or leave it out."
        )
    largest = 2**bit_depth - 1
    if frame.max() > largest:
        needed = int(frame.max()).bit_length()
        raise ParameterError(
            f"`bit_depth` ({bit_depth}) allows numbers up to {largest:,}, but the frame holds {frame.max():,}: "
            f"it has at least {needed} bits. Leave it out if the numbers fill the file's type."
        )
    return float(largest)


def as_image(frame: Frame, scale: float) -> Image:
    """(H, W, C) numbers to (1, C, H, W) parts of the full scale."""
    return torch.from_numpy(frame.astype(np.float32)).movedim(-1, 0)[None].contiguous() / scale


def demosaiced(image: Tensor, mosaic: Mosaic) -> Tensor:
    """Turn each 2 x 2 cells of a colour filter array into one pixel; its two greens are averaged.

    Each colour keeps its own place in the cell, in a PSF as in a capture, so that scenes come out without fringes.

    Args:
        image: (B, 1, H, W), of even sides.
        mosaic: colours of the first two cells of the first row, then of the second.

    Returns:
        (B, 3, H / 2, W / 2), red, green, blue.

    Raises:
        ShapeError: it has colours already, or odd sides.
        UnknownNameError: no such mosaic.
    """
    if mosaic not in get_args(Mosaic):
        raise UnknownNameError("mosaic", mosaic, get_args(Mosaic))
    channels, height, width = image.shape[1:]
    if channels != 1 or height % 2 or width % 2:
        raise ShapeError(f"A raw mosaic ({channels} x {height} x {width}) must have one channel and even sides.")
    cells = [image[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]
    planes = [[cell for cell, letter in zip(cells, mosaic, strict=True) if letter == colour] for colour in "rgb"]
    return torch.cat([sum(plane[1:], plane[0]) / len(plane) for plane in planes], dim=1)


def crop_centre(image: Tensor, size: Size) -> Tensor:
    """Middle ``size`` of a picture, such that the centre ``(h // 2, w // 2)`` stays the centre.

    Raises:
        ShapeError: the picture is smaller.
    """
    height, width = image.shape[-2:]
    if size[0] > height or size[1] > width or min(size) < 1:
        raise ShapeError(f"`crop` ({size[0]} x {size[1]}) must be within the frame ({height} x {width}).")
    top, left = height // 2 - size[0] // 2, width // 2 - size[1] // 2
    return image[..., top : top + size[0], left : left + size[1]]


def bin_pixels(image: Tensor, factor: int) -> Tensor:
    """Average blocks of ``factor`` x ``factor`` pixels, such that the block of the centre becomes the centre.

    Raises:
        ParameterError: the factor is not positive, or larger than the picture.
    """
    if not 1 <= factor <= min(image.shape[-2:]):
        raise ParameterError(f"`binning` ({factor}) must be at least 1 and at most {min(image.shape[-2:])}.")
    if factor == 1:
        return image
    # The first rows left over are cut so that the old centre falls into the new centre's block.
    blocks = [n // factor for n in image.shape[-2:]]
    start = [
        min(max(n // 2 - (m // 2) * factor, 0), n - m * factor) for n, m in zip(image.shape[-2:], blocks, strict=True)
    ]
    image = image[..., start[0] : start[0] + blocks[0] * factor, start[1] : start[1] + blocks[1] * factor]
    return torch.nn.functional.avg_pool2d(image, factor)


def estimate_background(image: Image) -> Tensor:
    """Level under a PSF, (1, C, 1, 1): the 5th percentile of each channel.

    A PSF leaves dark places between its lines; stray light and the sensor's offset fill them evenly. A lower
    percentile would follow the noise of the darkest pixels, a higher one the tails of the PSF itself: on the
    paper's camera 5 % gives the sharpest reconstructions, 50 % washes them out.
    """
    pixels = image.flatten(2).sort(dim=-1).values
    return pixels[..., int(0.05 * pixels.shape[-1])][..., None, None]
