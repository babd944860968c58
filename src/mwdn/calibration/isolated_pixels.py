"""Find hot pixels in a capture, without a dark frame."""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.optics.noise import noise_level
from mwdn.types import Image

ISOLATED = 4.0, 8.0
"""Standard deviations of a capture's noise by which a pixel exceeds its neighbours: suspected of being hot, and hot."""

MAX_ISOLATED = 2e-3
"""Largest fraction of hot pixels in a capture; more than that is light. Sensors have up to 5e-4."""


def find_isolated_pixels(capture: Image, *, cell: int = 1) -> Tensor:
    """Find hot pixels of a capture, from the capture alone.

    Light behind a mask is smooth from pixel to pixel. So a pixel is hot if it exceeds all of its eight neighbours but
    one by eight standard deviations of the noise, which grows with the root of the light. A scene of a few points
    leaves such pixels, too, but with any excess: nothing is found unless most of those above four standard deviations
    are above eight.

    Args:
        capture: (1, C, H, W), dark frame subtracted.
        cell: 2 for a mosaic, whose four kinds of pixels are examined separately.

    Returns:
        (1, 1, H, W), bool: hot in any colour.
    """
    import cv2

    if min(capture.shape[-2:]) < 2 * cell or any(length % cell for length in capture.shape[-2:]):
        return torch.zeros(1, 1, *capture.shape[-2:], dtype=torch.bool)
    planes = F.pixel_unshuffle(capture, cell)[0]  # (C cell^2, h, w)
    noise = float(noise_level(planes[None]).square().mean().sqrt())
    # A median of 3 x 3 pixels, which is cheap, leaves few to compare with each of their neighbours.
    median = np.stack([cv2.medianBlur(plane, 3) for plane in planes.numpy()])
    channel, y, x = (planes - torch.from_numpy(median) > ISOLATED[0] * noise).nonzero().T
    padded = F.pad(planes[None], (1, 1, 1, 1), mode="replicate")[0]
    around = [padded[channel, y + i, x + j] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    level = torch.stack(around).topk(2, dim=0).values[-1]
    deviation = noise * (level / planes.mean().clamp(min=1e-12)).clamp(min=1).sqrt()
    excess = (planes[channel, y, x] - level) / deviation.clamp(min=1e-12)
    hot = excess > ISOLATED[1]
    count, suspected = int(hot.sum()), int((excess > ISOLATED[0]).sum())
    hot_mask = torch.zeros_like(planes)
    if count >= suspected / 2 and count <= MAX_ISOLATED * planes.numel():
        hot_mask[channel[hot], y[hot], x[hot]] = 1.0
    return F.pixel_shuffle(hot_mask[None], cell).amax(1, keepdim=True) > 0
