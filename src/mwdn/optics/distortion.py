"""Distortion of pictures: where a scene's light lies in the reconstruction, as polynomials over the frame.

The scene at p is seen at ``p + d(p)``. Each component of d is a polynomial of the position, which goes from -1 to 1
over the frame. Its unit is half of the frame's height or width, so that it applies to pictures of any size.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.optics.polynomials import frame_places, polynomial
from mwdn.types import Image, Scene, Size, size_of

_INVERSIONS = 3
"""Fixed-point steps; each multiplies the error by the derivative of d, a few hundredths."""


def undistort(picture: Image, coefficients: Tensor) -> Scene:
    """Remove the distortion: ``T(p) = I(p + d(p))``, bicubic; beyond the frame the border is repeated.

    Args:
        picture: I, (B, C, H, W).
        coefficients: (2, K), of the displacement d down and right.
    """
    y, x = frame_places(size_of(picture))
    down, right = polynomial(coefficients, y, x)
    return _look_up(picture, y + down, x + right)


def distort(scene: Scene, coefficients: Tensor) -> Image:
    """The scene as a reconstruction shows it, the inverse of `undistort`: ``I(q) = T(p)`` with ``p = q - d(p)``."""
    y, x = place = frame_places(size_of(scene))
    for _ in range(_INVERSIONS):
        down, right = polynomial(coefficients, *place)
        place = y - down, x - right
    return _look_up(scene, *place)


def displacement_px(coefficients: Tensor, size: Size) -> tuple[float, float]:
    """Length of d over a frame in pixels: root mean square, maximum."""
    height, width = size
    down, right = polynomial(coefficients, *frame_places(size))
    length = torch.hypot(down * (height - 1) / 2, right * (width - 1) / 2)
    return float(length.square().mean().sqrt()), float(length.max())


def _look_up(picture: Image, y: Tensor, x: Tensor) -> Image:
    grid = torch.stack([x, y], -1).to(picture).expand(picture.shape[0], -1, -1, -1)
    return F.grid_sample(picture, grid, mode="bicubic", padding_mode="border", align_corners=True)
