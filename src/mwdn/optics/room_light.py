"""Light of a room on the sensor that has not come from the scene through the mask."""

import math

import torch
from torch import Tensor

from mwdn.types import Size


def even_light(size: Size) -> Tensor:
    """The same light everywhere, (H, W) of mean 1."""
    return torch.ones(size)


def sloping_light(size: Size, angle: float) -> Tensor:
    """Light that rises linearly across the frame, from 0 to 2 between two opposite corners: a window at one side.

    Args:
        size: height and width of the sensor.
        angle: direction of the rise in radians; 0 is to the right, pi / 2 down.

    Returns:
        (H, W), of mean 1.
    """
    y, x = ((2 * torch.arange(n) + 1) / n - 1 for n in size)
    down, right = math.sin(angle), math.cos(angle)
    return 1 + (y[:, None] * down + x * right) / (abs(down) + abs(right))


def spot_light(size: Size, centre: tuple[float, float], sigma: float) -> Tensor:
    """A Gaussian spot: a lamp that shines past the mask, or its reflection.

    Args:
        size: height and width of the sensor.
        centre: of the spot, over height and width: (0.5, 0.5) is the middle of the frame.
        sigma: standard deviation over the frame's width; 0.15 is narrow, 0.5 wide.

    Returns:
        (H, W), of mean 1: the light that falls beside the sensor does not count.
    """
    height, width = size
    y, x = torch.arange(height)[:, None] + 0.5 - centre[0] * height, torch.arange(width) + 0.5 - centre[1] * width
    spot = torch.exp(-0.5 * (y.square() + x.square()) / (sigma * width) ** 2)
    return spot / spot.mean()
