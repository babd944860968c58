"""Contact sheets: pictures side by side, with a title above each column."""

from typing import overload

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import check_batch
from mwdn.errors import ShapeError
from mwdn.io.arrays import as_frame
from mwdn.io.images import srgb_decode
from mwdn.types import ArrayPicture, FloatFrame, Image

CLIPPED_SHARE = 0.003
"""Part of a picture's values that are white in a display: `to_display` clips them."""


@overload
def to_display(image: Tensor) -> Tensor: ...


@overload
def to_display(image: ArrayPicture) -> FloatFrame: ...


def to_display(image: Tensor | ArrayPicture) -> Tensor | FloatFrame:
    """Scale each image of a batch such that all but its brightest 0.3 % of values are within [0, 1], and clip it.

    The absolute brightness of a reconstruction depends on the exposures of the capture and of the PSF.

    Args:
        image: tensor (B, C, H, W), or numpy array or PIL picture (H, W) or (H, W, 1 or 3), linear light of any scale.

    Returns:
        A tensor of the same shape, or a float32 array of the same shape; `mwdn.write_picture` takes both.

    Raises:
        ImageError: an array has other axes or types, NaN or infinity.
        ShapeError: a tensor has other axes, or no pixels.
        ParameterError: a tensor of integers.
    """
    if not isinstance(image, Tensor):
        frame = torch.from_numpy(as_frame(image).astype(np.float32))
        return to_display(frame.movedim(-1, 0)[None])[0].movedim(0, -1).numpy().reshape(np.asarray(image).shape)
    check_batch(image, "image")
    if 0 in image.shape[1:]:
        raise ShapeError(f"`image` {tuple(image.shape)} must have pixels.")
    pixels = image.float().flatten(1)
    brightest = pixels.kthvalue(pixels.shape[1] - int(CLIPPED_SHARE * pixels.shape[1])).values
    return (image / brightest.clamp(min=1e-12)[:, None, None, None]).clamp(0, 1)


def contact_sheet(rows: list[list[Tensor]], titles: list[str], *, height: int = 240) -> Tensor:
    """Arrange pictures in rows, each scaled by `to_display` and resized to the same height.

    Args:
        rows: lists of (1, 1 or 3, H, W) in linear light, one picture per title.
        titles: of the columns.
        height: of each picture.

    Returns:
        (1, 3, H, W) in linear light.
    """
    gap, heading = 6, 26
    cells = [[_cell(picture, height, gap) for picture in row] for row in rows]
    lines = [torch.cat(row, dim=-1) for row in cells]
    widest = max(line.shape[-1] for line in lines)
    lines = [F.pad(line, (0, widest - line.shape[-1], 0, 0), value=1.0) for line in lines]
    widths = [cell.shape[-1] for cell in cells[0]]
    return torch.cat([_draw_titles(titles, widths, heading, widest), *lines], dim=-2)


def thumbnail(picture: Image, height: int = 240) -> Tensor:
    """Downscale a picture to the height of a contact sheet, if it is taller."""
    if picture.shape[-2] <= height:
        return picture
    return F.interpolate(picture, (height, _width(picture, height)), mode="area")


def _cell(picture: Tensor, height: int, gap: int) -> Tensor:
    picture = thumbnail(to_display(picture), height)
    if picture.shape[-2] < height:
        picture = F.interpolate(picture, (height, _width(picture, height)), mode="bicubic").clamp(0, 1)
    return F.pad(picture.expand(-1, 3, -1, -1), (0, gap, 0, gap), value=1.0)


def _width(picture: Tensor, height: int) -> int:
    return max(1, round(picture.shape[-1] * height / picture.shape[-2]))


def _draw_titles(titles: list[str], widths: list[int], height: int, total: int) -> Tensor:
    import cv2

    canvas = np.full((height, total), 255, np.uint8)
    font, size, left = cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0
    for title, width in zip(titles, widths, strict=True):
        (needed, _), _ = cv2.getTextSize(title, font, size, 1)
        fitting = size * min(1.0, (width - 4) / max(needed, 1))  # smaller letters where the column is narrow
        cv2.putText(canvas, title, (left + 2, height - 8), font, fitting, 0, 1, cv2.LINE_AA)
        left += width
    return srgb_decode(torch.from_numpy(canvas / np.float32(255)))[None, None].expand(1, 3, -1, -1)
