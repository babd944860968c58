"""Draws which parts of a picture are supported: its brightness, coloured by the support, above a legend."""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.io.contact_sheets import to_display
from mwdn.io.images import srgb_decode, srgb_encode
from mwdn.types import Image

_COLOURS = ((0.80, 0.42, 0.26), (0.82, 0.76, 0.60), (0.22, 0.56, 0.60))
"""sRGB colours of no support, half support and full support: terracotta, sand, teal."""

_HEIGHT = 320
"""Smallest height of the drawing: smaller pictures are enlarged, so that the legend fits below."""

_LEGEND = 44


def support_picture(picture: Image, support: Tensor) -> Tensor:
    """Draw a picture with its support as colour.

    Args:
        picture: (1, C, H, W), linear light.
        support: (rows, columns), 0 to 1, evenly spread over the picture.

    Returns:
        (1, 3, height, width) in linear light.
    """
    height = max(_HEIGHT, picture.shape[-2])
    size = (height, max(_HEIGHT, round(picture.shape[-1] * height / picture.shape[-2])))
    grey = srgb_encode(to_display(picture.float().clamp(min=0)).mean(1, keepdim=True))
    grey = F.interpolate(grey, size, mode="bilinear")
    smooth = F.interpolate(support[None, None].float(), size, mode="bilinear")
    drawing = _coloured(smooth) * (0.3 + 0.7 * grey)
    return srgb_decode(torch.cat([drawing, _legend(size[1])], dim=-2))


def _coloured(support: Tensor) -> Tensor:
    """Colours (1, 3, H, W) of a map (1, 1, H, W), linear between those of `_COLOURS`."""
    low, middle, high = (support.new_tensor(colour)[:, None, None] for colour in _COLOURS)
    below, above = (2 * support).clamp(max=1), (2 * support - 1).clamp(min=0)
    return low + below * (middle - low) + above * (high - middle)


def _legend(width: int) -> Tensor:
    """A bar of colours and what its ends mean, (1, 3, `_LEGEND`, width) in sRGB."""
    import cv2

    canvas = np.full((_LEGEND, width, 3), 255, np.uint8)
    ramp = _coloured(torch.linspace(0, 1, width - 16).expand(1, 1, 10, -1))
    canvas[8:18, 8:-8] = (255 * ramp[0].movedim(0, -1)).round().byte().numpy()
    style = (cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    right = "the capture supports this"
    cv2.putText(canvas, "not supported", (8, _LEGEND - 10), *style)
    cv2.putText(canvas, right, (width - 8 - cv2.getTextSize(right, *style[:2], 1)[0][0], _LEGEND - 10), *style)
    return torch.from_numpy(canvas / np.float32(255)).movedim(-1, 0)[None]
