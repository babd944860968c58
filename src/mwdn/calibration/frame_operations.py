"""Steps from a raw frame to a measurement and back: dark frame, demosaicing, crop, binning, interpolation."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.errors import ParameterError, ShapeError
from mwdn.io.raw import Mosaic
from mwdn.types import Image, Size


def subtract_dark(image: Image, dark: Tensor) -> Image:
    """Subtract a dark or ambient frame (1, C or 1, H, W).

    Raises:
        ShapeError: it has another size or other colours.
    """
    if dark.shape[-2:] != image.shape[-2:] or dark.shape[1] not in (1, image.shape[1]):
        raise ShapeError(
            f"The frame to subtract, `dark` or `ambient` {tuple(dark.shape[1:])}, must have the size of the frame "
            f"{tuple(image.shape[1:])}, and its colours unless it is grey. Take it with the same camera settings."
        )
    return image - dark


def demosaic(image: Tensor, mosaic: Mosaic) -> Tensor:
    """Turn each 2 x 2 cell of a colour filter array into one pixel; its two greens are averaged.

    The colours of a cell are not interpolated to a common position. Their offsets are the same in the PSF and in the
    captures, so reconstructions have no colour fringes.

    Args:
        image: (B, 1, H, W), H and W even.
        mosaic: colours of the cell's first row, then of its second row.

    Returns:
        (B, 3, H / 2, W / 2), red, green, blue.

    Raises:
        ShapeError: more than one channel, or an odd height or width.
    """
    channels, height, width = image.shape[1:]
    if channels != 1:
        raise ShapeError(
            f"`mosaic` ({mosaic}) is for raw frames of one channel, but a frame ({height} x {width}) has {channels}. "
            "Use the raw frames of both the PSF and the captures; or, if all have colours, leave it out."
        )
    if height % 2 or width % 2:
        raise ShapeError(f"`mosaic` ({mosaic}) needs frames of even sides, not {height} x {width}. Crop them.")
    samples = [image[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]
    colours = [[sample for sample, letter in zip(samples, mosaic, strict=True) if letter == c] for c in "rgb"]
    return torch.cat([sum(same[1:], same[0]) / len(same) for same in colours], dim=1)


def crop_centre(image: Tensor, size: Size, cell: int = 1) -> Tensor:
    """Crop to the central ``size``; the centre ``(H // 2, W // 2)`` stays the centre.

    Args:
        image: (..., H, W).
        size: height and width in pixels, multiples of ``cell``.
        cell: keep cells of a mosaic, of this many pixels along each axis, whole; the central cell stays the centre.

    Raises:
        ShapeError: the image is smaller.
    """
    height, width = image.shape[-2:]
    if size[0] > height or size[1] > width or min(size) < 1:
        raise ShapeError(f"`crop` ({size[0]} x {size[1]}) must be within the frame ({height} x {width}).")
    top = (height // cell // 2 - size[0] // cell // 2) * cell
    left = (width // cell // 2 - size[1] // cell // 2) * cell
    return image[..., top : top + size[0], left : left + size[1]]


def bin_pixels(image: Tensor, factor: int) -> Tensor:
    """Average blocks of ``factor`` x ``factor`` pixels; the block that holds the centre becomes the centre.

    Raises:
        ParameterError: the factor is not positive, or larger than the image.
    """
    if not 1 <= factor <= min(image.shape[-2:]):
        raise ParameterError(f"`bin` ({factor}) must be at least 1 and at most {min(image.shape[-2:])}.")
    if factor == 1:
        return image
    # Leftover rows and columns are cut on both sides such that pixel n // 2 falls into block (n // factor) // 2.
    blocks = [n // factor for n in image.shape[-2:]]
    start = [
        min(max(n // 2 - (m // 2) * factor, 0), n - m * factor) for n, m in zip(image.shape[-2:], blocks, strict=True)
    ]
    image = image[..., start[0] : start[0] + blocks[0] * factor, start[1] : start[1] + blocks[1] * factor]
    return F.avg_pool2d(image, factor)


def enlarge_binned(image: Tensor, factor: int, size: Size) -> Tensor:
    """Interpolate a reconstruction of binned frames at the pixels before binning, bicubic and without overshoot.

    The centre ``(H // 2, W // 2)`` stays the centre, for the PSF's displacements count from there. At the border, where
    `bin_pixels` has cut rows and columns, the outermost values are repeated.

    Args:
        image: (B, C, H, W), linear light.
        factor: of `bin_pixels`.
        size: height and width before binning.
    """
    places = [
        (2 * ((torch.arange(length) - length // 2) / factor + blocks // 2) + 1) / blocks - 1
        for length, blocks in zip(size, image.shape[-2:], strict=True)
    ]
    rows, columns = torch.meshgrid(*places, indexing="ij")
    grid = torch.stack([columns, rows], -1)[None].expand(len(image), -1, -1, -1).to(image)
    enlarged = F.grid_sample(image, grid, mode="bicubic", padding_mode="border", align_corners=False)
    return enlarged.clamp(image.amin(), image.amax())
