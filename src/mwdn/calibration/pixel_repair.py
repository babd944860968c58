"""Replace defective pixels by their neighbours."""

import torch
from torch import Tensor

from mwdn.errors import ShapeError
from mwdn.types import Image

MAX_RINGS = 8
"""Distance, in pixels of the same colour, to which a good pixel is searched: the rings of defects that are 16 wide."""


class PixelRepair:
    """Replaces defective pixels by the mean of the nearest good ones of the same colour.

    A pixel without a good one within `MAX_RINGS` stays as it is.

    Args:
        defects: (H, W), true at a defective pixel.
        cell: 2 for a mosaic, whose nearest pixels of a colour are two pixels away.
    """

    def __init__(self, defects: Tensor, cell: int = 1) -> None:
        self.size = tuple(defects.shape)
        rows, columns = defects.nonzero().T
        self.index = rows * self.size[1] + columns
        good = ~defects
        neighbours, weights, alone = [], [], torch.ones(len(rows))
        # Rings of growing size, until each defective pixel has a good neighbour.
        for ring in range(1, MAX_RINGS + 1):
            found = torch.zeros(len(rows))
            for down, right in _ring(ring):
                y, x = rows + down * cell, columns + right * cell
                inside = (y >= 0) & (y < self.size[0]) & (x >= 0) & (x < self.size[1])
                y, x = y.clamp(0, self.size[0] - 1), x.clamp(0, self.size[1] - 1)
                neighbours.append(y * self.size[1] + x)
                weights.append((inside & good[y, x]).float() * alone)
                found += weights[-1]
            alone = alone * (found == 0)
            if not alone.any():
                break
        neighbours.append(self.index)
        weights.append(alone)
        self.neighbours = torch.stack(neighbours)
        total = torch.stack(weights)
        self.weights = total / total.sum(0).clamp(min=1e-30)

    def __call__(self, image: Image) -> Image:
        """The image with its defective pixels replaced.

        Args:
            image: (B, C, H, W), in the pixels of the raw frame.

        Raises:
            ShapeError: it has another size.
        """
        if tuple(image.shape[-2:]) != self.size:
            raise ShapeError(
                f"The map of hot pixels ({self.size[0]} x {self.size[1]}) must have the size of the frame "
                f"({image.shape[-2]} x {image.shape[-1]}). Use raw frames of the camera, or remove "
                "`hot_pixels` from the camera file."
            )
        if not len(self.index):
            return image
        flat = image.flatten(-2).clone()
        values: Tensor = (flat[..., self.neighbours] * self.weights).sum(-2)
        flat[..., self.index] = values
        return flat.reshape(image.shape)


def _ring(radius: int) -> list[tuple[int, int]]:
    """Places at this distance from a pixel, in the maximum norm."""
    steps = range(-radius, radius + 1)
    return [(down, right) for down in steps for right in steps if max(abs(down), abs(right)) == radius]
