"""A folder of photographs, held in memory as a training set wants it."""

import copy
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mwdn.errors import ImageError, ParameterError
from mwdn.io.images import READABLE, read_frame, srgb_decode
from mwdn.types import Frame


class Photographs:
    """The middle square of every photograph of a folder, as sRGB bytes.

    3,000 photographs of 208 x 208 take 390 MB and are decoded once; cropping and turning belongs to whoever places
    them in a scene.

    Args:
        folder: searched for pictures, also in its folders; hidden ones are none.
        side: pixels along each side of a square.
        limit: read only the first so many, in the order of their names.

    Raises:
        ParameterError: the folder holds no picture.
        ImageError: a picture cannot be read; the message names it.
    """

    def __init__(self, folder: str | Path, *, side: int = 208, limit: int | None = None) -> None:
        paths = sorted(p for p in Path(folder).rglob("*") if _is_picture(p))[:limit]
        if not paths:
            raise ParameterError(f"The folder `{folder}` holds no photograph. Readable: {', '.join(sorted(READABLE))}.")
        self.names = [path.name for path in paths]
        with ThreadPoolExecutor() as pool:
            self._pixels = torch.from_numpy(np.stack(list(pool.map(lambda path: _square(path, side), paths))))
        self._light = srgb_decode(torch.arange(256) / 255)

    def __len__(self) -> int:
        return len(self._pixels)

    def light(self, index: Tensor) -> Tensor:
        """Linear light (B, 3, side, side) of the photographs at ``index`` (B,)."""
        return self._light[self._pixels[index].long()].movedim(-1, 1)

    def split(self, every: int) -> tuple["Photographs", "Photographs"]:
        """All but one in ``every`` photographs, and those; of fewer than ``every``, all are in both."""
        held = torch.arange(len(self), device=self._pixels.device) % every == every - 1
        if not held.any():
            return self, self
        parts = []
        for chosen in (~held, held):
            part = copy.copy(self)
            part._pixels = self._pixels[chosen]
            part.names = [name for name, taken in zip(self.names, chosen.tolist(), strict=True) if taken]
            parts.append(part)
        return parts[0], parts[1]

    def to(self, device: torch.device | str) -> "Photographs":
        """Keep the pictures on a device, where they are sampled."""
        self._pixels, self._light = self._pixels.to(device), self._light.to(device)
        return self


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in READABLE and not path.name.startswith(".") and path.is_file()


def _square(path: Path, side: int) -> Frame:
    import cv2

    frame = read_frame(path, upright=True)
    if frame.dtype != np.uint8:
        raise ImageError(f"`{path}` holds {frame.dtype}; photographs for training have 8 bits. Save it as JPEG.")
    height, width = frame.shape[:2]
    short = min(height, width)
    top, left = (height - short) // 2, (width - short) // 2
    square = np.ascontiguousarray(np.broadcast_to(frame, (height, width, 3))[top : top + short, left : left + short])
    return square if short == side else cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA)
