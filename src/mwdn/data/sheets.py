"""Contact sheets: pictures side by side under their titles."""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.data.images import srgb_decode
from mwdn.types import Image


def for_people(image: Image) -> Image:
    """Scale each picture of a batch so that all but its brightest 0.3 % fit into [0, 1].

    A reconstruction's absolute brightness depends on the exposure and on the PSF's; people want to see a picture.
    """
    brightest = torch.stack(
        [picture.float().flatten().sort().values[int(-0.003 * picture.numel()) - 1] for picture in image]
    )
    return (image / brightest.clamp(min=1e-12)[:, None, None, None]).clamp(0, 1)


def contact_sheet(rows: list[list[Tensor]], titles: list[str], *, height: int = 240) -> Tensor:
    """Arrange pictures in rows, each scaled by `for_people` and resized to one height.

    Args:
        rows: lists of (1, 1 or 3, H, W) in linear light, as many a row as there are titles.
        titles: of the columns.
        height: of each picture.

    Returns:
        (1, 3, H, W) in linear light.
    """
    gap, head = 6, 26
    lines = [torch.cat([_cell(picture, height, gap) for picture in row], dim=-1) for row in rows]
    widest = max(line.shape[-1] for line in lines)
    lines = [F.pad(line, (0, widest - line.shape[-1], 0, 0), value=1.0) for line in lines]
    widths = [_cell(picture, height, gap).shape[-1] for picture in rows[0]]
    return torch.cat([_heading(titles, widths, head, widest), *lines], dim=-2)


def _cell(picture: Image, height: int, gap: int) -> Tensor:
    picture = for_people(picture).expand(-1, 3, -1, -1)
    width = max(1, round(picture.shape[-1] * height / picture.shape[-2]))
    smaller = height < picture.shape[-2]
    picture = F.interpolate(picture, (height, width), mode="area" if smaller else "bicubic").clamp(0, 1)
    return F.pad(picture, (0, gap, 0, gap), value=1.0)


def _heading(titles: list[str], widths: list[int], height: int, total: int) -> Tensor:
    import cv2

    canvas = np.full((height, total), 255, np.uint8)
    left = 0
    for title, width in zip(titles, widths, strict=True):
        cv2.putText(canvas, title, (left + 2, height - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0, 1, cv2.LINE_AA)
        left += width
    return srgb_decode(torch.from_numpy(canvas / np.float32(255)))[None, None].expand(1, 3, -1, -1)
