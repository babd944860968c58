"""Live pictures as JPEGs, in about a millisecond: a table in place of the power of sRGB for each number."""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from mwdn.io.contact_sheets import CLIPPED_SHARE
from mwdn.io.images import srgb_encode

QUALITY = 90
"""Of the JPEGs."""


def brightest(image: Tensor) -> float:
    """The number that becomes white: that of `to_display`, estimated from each fourth pixel. At least 1e-12."""
    numbers = np.ascontiguousarray(image[0, :, ::2, ::2].numpy()).ravel()
    rank = numbers.size - 1 - int(CLIPPED_SHARE * numbers.size)
    return max(float(np.partition(numbers, rank)[rank]), 1e-12)


def encode_jpeg(image: Tensor, white: float) -> bytes:
    """A JPEG in sRGB.

    Args:
        image: (1, 1 or 3, H, W), linear light.
        white: number that becomes white.
    """
    import cv2

    planes = np.ascontiguousarray(image[0].numpy())
    # OpenCV rounds to 16 bits and clips at both ends in one pass; so fine a step is less than one code of sRGB.
    rows: Any = planes.reshape(-1, planes.shape[-1])
    scale: Any = 65535 / white
    light: Any = cv2.multiply(rows, scale, dtype=cv2.CV_16U)
    codes: Any = _table().take(light).reshape(planes.shape)
    pixels = codes[0] if len(codes) == 1 else cv2.merge([codes[2], codes[1], codes[0]])
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


@cache
def _table() -> npt.NDArray[np.uint8]:
    """Codes of sRGB for 0, 1/65535, ..., 1."""
    return srgb_encode(torch.arange(65536) / 65535).mul(255).round().byte().numpy()
