"""A folder of photographs in memory, cropped and scaled for training."""

import copy
import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mwdn.errors import ImageError, ParameterError
from mwdn.io.images import READABLE, read_frame, srgb_decode
from mwdn.io.listing import pictures_in
from mwdn.types import Frame


class Photographs:
    """The central square of every photograph of a folder, as sRGB bytes.

    Each file is decoded once; 3,000 photographs of 208 x 208 pixels take 390 MB.

    Args:
        folder: searched for pictures with its subfolders; hidden files are skipped.
        side: pixels along each side of a square.
        limit: read only this many, in the order of their names.

    Raises:
        ParameterError: there is no such folder, or it holds no picture.
        ImageError: a picture cannot be read; the message has its path.
    """

    def __init__(self, folder: str | Path, *, side: int = 208, limit: int | None = None) -> None:
        paths = pictures_in(Path(folder))[:limit]
        if not paths:
            if not Path(folder).is_dir():
                raise ParameterError(f"`{folder}` is not a folder. Name a folder of photographs.")
            raise ParameterError(f"The folder `{folder}` holds no photograph. Readable: {', '.join(sorted(READABLE))}.")
        self.names = [path.name for path in paths]
        with ThreadPoolExecutor() as pool:
            self._pixels = torch.from_numpy(np.stack(list(pool.map(lambda path: _square(path, side), paths))))
        self._light = srgb_decode(torch.arange(256) / 255)

    def __len__(self) -> int:
        return len(self._pixels)

    @property
    def content(self) -> str:
        """Hash of all pixels, and of their order."""
        return hashlib.sha256(self._pixels.cpu().numpy().data).hexdigest()

    def light(self, index: Tensor) -> Tensor:
        """Linear light (B, 3, side, side) of the photographs at ``index`` (B,)."""
        return self._light[self._pixels[index].long()].movedim(-1, 1)

    def split(self, every: int) -> tuple["Photographs", "Photographs"]:
        """Split off one photograph in ``every`` for validation; of fewer than ``every``, all are in both parts."""
        held_out = torch.arange(len(self), device=self._pixels.device) % every == every - 1
        if not held_out.any():
            return self, self
        parts = []
        for chosen in (~held_out, held_out):
            part = copy.copy(self)
            part._pixels = self._pixels[chosen]
            part.names = [name for name, taken in zip(self.names, chosen.tolist(), strict=True) if taken]
            parts.append(part)
        return parts[0], parts[1]

    def to(self, device: torch.device | str) -> "Photographs":
        """The photographs on a device, on which `light` works."""
        moved = copy.copy(self)
        moved._pixels, moved._light = self._pixels.to(device), self._light.to(device)
        return moved


def _square(path: Path, side: int) -> Frame:
    import cv2

    frame = read_frame(path, upright=True)
    if frame.dtype != np.uint8:
        raise ImageError(f"`{path}` holds {frame.dtype}; photographs for training must have 8 bits. Save it as JPEG.")
    height, width = frame.shape[:2]
    short = min(height, width)
    top, left = (height - short) // 2, (width - short) // 2
    square = np.ascontiguousarray(np.broadcast_to(frame, (height, width, 3))[top : top + short, left : left + short])
    return square if short == side else cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA)
