"""Find defective pixels in dark and flat frames."""

import numpy as np
import torch
from torch import Tensor

from mwdn.calibration.frame_average import FrameAverage
from mwdn.types import Plane

HOT = 6.0
"""Standard deviations of the averaged dark frame above which a pixel is hot: 1e-9 of the good ones."""

DEAD = 0.5
"""Relative deviation from its neighbours, in a flat frame, from which on a pixel is defective."""


def find_hot_pixels(dark: FrameAverage, *, cell: int = 1) -> Tensor:
    """Find pixels of a dark frame that are brighter than their surroundings.

    The local level is the median of 5 x 5 pixels, of one colour of a mosaic. The difference is noise, whose standard
    deviation is estimated without outliers, and hot pixels.

    Args:
        dark: the average of dark frames.
        cell: 2 for a mosaic, whose four kinds of pixels are examined separately.

    Returns:
        (1, 1, H, W), bool, in the pixels of the raw frame.
    """
    image = dark.image.amax(1)[0]
    excess = image - _local_median(image, cell)
    rough = float(np.percentile(excess.abs().numpy(), 68))
    kept = excess[excess.abs() <= 5 * rough]
    # Where the black level cuts off the noise, most pixels are 0: quantisation alone bounds the deviation.
    floor = 0.0 if dark.noise is None else (dark.noise.floor / dark.count) ** 0.5
    deviation = max(float(kept.std()), floor, 1e-9)
    return (excess > HOT * deviation)[None, None]


def find_dead_pixels(flat: Plane, *, cell: int = 1) -> Tensor:
    """Find pixels of a flat frame (H, W) that are darker or brighter than their surroundings by `DEAD`."""
    local = _local_median(flat, cell)
    return ((flat - local).abs() > DEAD * local.clamp(min=1e-6))[None, None]


def _local_median(image: Plane, cell: int) -> Plane:
    """Median of 5 x 5 pixels of the same position in the cell of a mosaic."""
    import cv2

    result = np.empty(tuple(image.shape), np.float32)
    for row in range(cell):
        for column in range(cell):
            part = np.ascontiguousarray(image[row::cell, column::cell].numpy(), np.float32)
            result[row::cell, column::cell] = cv2.medianBlur(part, 5)
    return torch.from_numpy(result)
