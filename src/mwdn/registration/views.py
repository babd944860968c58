"""Displayed pictures and reconstructions of them, as the grey arrays that registration compares."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from torch import Tensor

from mwdn.errors import ShapeError
from mwdn.types import FloatFrame, Size

Bytes = npt.NDArray[np.uint8]
"""A grey picture of 8 bits, (H, W)."""


@dataclass(frozen=True, eq=False)
class Views:
    """Pictures that were displayed one after the other at the same place, and the reconstructions of their captures.

    Args:
        pictures: (N, h, w), mean colour in linear light, 1 for the brightest of each.
        reconstructions: (N, H, W), likewise.
    """

    pictures: FloatFrame
    reconstructions: FloatFrame

    @classmethod
    def of(cls, pictures: Sequence[Tensor], reconstructions: Sequence[Tensor]) -> "Views":
        """From pictures (C, h, w) and reconstructions (C, H, W), linear light of any scale.

        Raises:
            ShapeError: their numbers differ, or they are not of one size.
        """
        if len(pictures) != len(reconstructions) or not pictures:
            raise ShapeError(f"`pictures` ({len(pictures)}) and `reconstructions` ({len(reconstructions)}) must match.")
        for name, images in (("pictures", pictures), ("reconstructions", reconstructions)):
            sizes = {tuple(image.shape[-2:]) for image in images}
            if len(sizes) > 1:
                raise ShapeError(f"`{name}` must be of one size, but have {sorted(sizes)}.")
        return cls(np.stack([_grey(each) for each in pictures]), np.stack([_grey(each) for each in reconstructions]))

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def picture_size(self) -> Size:
        """Height and width of a displayed picture."""
        return self.pictures.shape[1], self.pictures.shape[2]

    @property
    def camera_size(self) -> Size:
        """Height and width of a reconstruction."""
        return self.reconstructions.shape[1], self.reconstructions.shape[2]

    def first(self, count: int) -> "Views":
        """At most ``count`` of them, evenly spread."""
        chosen = np.unique(np.linspace(0, len(self) - 1, min(count, len(self))).round().astype(int))
        return Views(self.pictures[chosen], self.reconstructions[chosen])

    @cached_property
    def bytes(self) -> tuple[list[Bytes], list[Bytes]]:
        """Pictures and reconstructions as 8 bits, for OpenCV's detectors."""
        return [_as_bytes(each) for each in self.pictures], [_as_bytes(each) for each in self.reconstructions]


def _grey(image: Tensor) -> FloatFrame:
    grey = image.detach().float().mean(-3).clamp(min=0).cpu().numpy()
    bright = max(float(np.quantile(grey, 0.998)), 1e-12)
    return (grey / bright).clip(0, 1.4).astype(np.float32)


def _as_bytes(image: FloatFrame) -> Bytes:
    return (255 * np.sqrt(image.clip(0, 1))).round().astype(np.uint8)


def compress(light: FloatFrame) -> FloatFrame:
    """Square root of light, nearly linear below a hundredth: bright artefacts weigh less, photon noise is even."""
    return np.asarray(np.sqrt(np.maximum(light, 0) + 0.01), np.float32)
