"""Corrections of the raw pixels of every frame: the flat field, and hot pixels."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from mwdn.calibration.isolated_pixels import find_isolated_pixels
from mwdn.calibration.pixel_repair import PixelRepair
from mwdn.errors import ImageError, ShapeError
from mwdn.io.images import read_frame
from mwdn.optics.saturation import keep_plateau
from mwdn.types import Image


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections of frames whose dark frame has been subtracted; none by default.

    Args:
        flat: (1, C or 1, H, W), response of each pixel relative to the mean, by which frames are divided.
        defects: (1, 1, H, W), bool, pixels that are replaced by the mean of their neighbours of the same colour.
        psf_done: the PSF's file is corrected already, also by the dark frame, as `mwdn calibrate FRAMES` writes it.
    """

    flat: Image | None = None
    defects: Tensor | None = None
    psf_done: bool = False

    @classmethod
    def read(cls, flat: str | Path | None, hot_pixels: str | Path | None, *, psf_done: bool = False) -> "Corrections":
        """Read the files of a camera: a flat field of floats, and a picture that is not 0 at hot pixels.

        Raises:
            ImageError: a file cannot be read, or the flat field is not positive.
        """
        image = defects = None
        if flat is not None:
            image = torch.from_numpy(read_frame(flat)).float().movedim(-1, 0)[None]
            if not bool((image > 0).all()):
                raise ImageError(f"`{flat}` must be positive, the response of each pixel. Calibrate again.")
        if hot_pixels is not None:
            defects = torch.from_numpy(read_frame(hot_pixels).max(-1) > 0)[None, None]
        return cls(image, defects, psf_done)

    def __call__(self, image: Image, cell: int = 1) -> Image:
        """Correct an image in the pixels of the raw frame.

        Args:
            image: (B, C, H, W), dark frame subtracted.
            cell: 2 for a mosaic.

        Raises:
            ShapeError: the flat field or the map of hot pixels has another size.
        """
        if self.flat is not None:
            if self.flat.shape[-2:] != image.shape[-2:] or self.flat.shape[1] not in (1, image.shape[1]):
                raise ShapeError(
                    f"The flat field {tuple(self.flat.shape[1:])} must have the size of the frame "
                    f"{tuple(image.shape[1:])}. Take frames with the same camera settings."
                )
            image = keep_plateau(image, image / self.flat)
        if self.defects is None:
            return image
        if cell not in self._repairs:
            self._repairs[cell] = PixelRepair(self.defects[0, 0], cell)
        return self._repairs[cell](image)

    def of_capture(self, image: Image, cell: int = 1) -> Image:
        """`__call__` for a capture (1, C, H, W). Without a map, hot pixels are sought in the capture itself."""
        image = self(image, cell)
        if self.defects is not None:
            return image
        hot = find_isolated_pixels(image, cell=cell)
        return PixelRepair(hot[0, 0], cell)(image) if hot.any() else image

    @cached_property
    def _repairs(self) -> dict[int, PixelRepair]:
        """Repairs by the cell of the frames; made once, because a stream corrects many frames."""
        return {}

    @property
    def count(self) -> int:
        """Number of hot pixels."""
        return 0 if self.defects is None else int(self.defects.sum())
