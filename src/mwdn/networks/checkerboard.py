"""Removal of the checkerboard that a denoiser with pixel (un)shuffling leaves in dark, smooth parts of a picture."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.networks.block_means import block_means
from mwdn.types import Scene, size_of

FAINT = 0.004
"""Largest detail that is taken for checkerboard, over the picture's brightest pixel. Edges and most texture are
above it."""

BLOCK = 16
"""Side in pixels of the blocks in which the checkerboard is measured."""


def remove_checkerboard(scene: Scene) -> Scene:
    """Subtract faint detail that repeats every second pixel, (B, C, H, W).

    The four pixels of each 2 x 2 cell leave a denoiser through different weights, so they differ a little where the
    scene is even. In dark parts sRGB makes that visible as a fine grid. Noise and texture have no such period: over a
    block they have nearly the same mean in all four pixels of a cell. Pictures smaller than a block are not changed.

    References:
        A. Odena, V. Dumoulin, C. Olah, "Deconvolution and checkerboard artifacts", Distill (2016).
    """
    height, width = size_of(scene)
    if min(height, width) < BLOCK:
        return scene
    detail = scene[..., 1:-1, 1:-1] - _blurred(scene)
    faint = torch.where(detail.abs() < FAINT * scene.amax((1, 2, 3), keepdim=True), detail, 0)
    # Reflection keeps the period; to an even size, because the cells are 2 x 2 pixels.
    whole = F.pad(faint, (1, 1 + width % 2, 1, 1 + height % 2), mode="reflect")
    means = block_means(F.pixel_unshuffle(whole, 2), BLOCK // 2).unflatten(1, (-1, 4))  # type: ignore[no-untyped-call]
    pattern = F.pixel_shuffle((means - means.mean(2, keepdim=True)).flatten(1, 2), 2)
    return scene - pattern[..., :height, :width]


def _blurred(image: Tensor) -> Tensor:
    """All but the border, with weights (1, 2, 1) / 4 along each axis, which keep a plane and erase a period of 2."""
    rows = (image[..., :-2, :] + image[..., 2:, :]) / 4 + image[..., 1:-1, :] / 2
    return (rows[..., :-2] + rows[..., 2:]) / 4 + rows[..., 1:-1] / 2
