"""Projection of a flat display's light to a camera's pixels."""

import math

import numpy as np
import torch

from mwdn.capture.screen import Homography
from mwdn.types import FloatFrame, Scene, Size

SUBPIXELS = 3
"""Points along each side of a camera's pixel whose light is averaged."""


def view(light: FloatFrame, homography: Homography, size: Size) -> Scene:
    """Project a display's light to a camera's pixels.

    Args:
        light: (H, W, 3), linear.
        homography: from the display's pixels to the camera's.
        size: height and width of the camera's measurements.

    Returns:
        (1, 3, *size): the mean light of the part of the display that each pixel sees; dark beside the display.
    """
    import cv2

    # Display pixels per sample, at the display's middle: if there are several, the display is downsampled first, so
    # that none is skipped.
    factor = max(min(int(1 / (_magnification(homography, light.shape[:2]) * SUBPIXELS)), *light.shape[:2]), 1)
    if factor > 1:
        height, width = (length // factor * factor for length in light.shape[:2])
        cells = light[:height, :width].reshape(height // factor, factor, width // factor, factor, -1)
        light = np.ascontiguousarray(cells.mean((1, 3)))
        homography = homography @ _scaled(float(factor))
    to_fine = _scaled(float(SUBPIXELS)) @ homography
    large = cv2.warpPerspective(light, to_fine, (size[1] * SUBPIXELS, size[0] * SUBPIXELS), flags=cv2.INTER_LINEAR)
    seen = torch.from_numpy(np.asarray(large)).movedim(-1, 0)[None]
    return torch.nn.functional.avg_pool2d(seen, SUBPIXELS)


def _scaled(factor: float) -> Homography:
    """To pixels that are smaller by a factor: (x + 1/2) factor - 1/2."""
    return np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1.0]])


def _magnification(homography: Homography, size: tuple[int, ...]) -> float:
    """Camera pixels per display pixel at the display's middle."""
    x, y = (size[1] - 1) / 2, (size[0] - 1) / 2
    corners = homography @ np.array([[x, x + 1, x], [y, y, y + 1], [1, 1, 1]])
    (x0, x1, x2), (y0, y1, y2) = (corners[:2] / corners[2]).tolist()
    return math.sqrt(abs((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)))
