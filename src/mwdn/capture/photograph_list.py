"""The photographs of a session: their order, and their conversion for the display."""

import random
import warnings
from pathlib import Path

import numpy as np

from mwdn.capture.screen import Picture
from mwdn.errors import ImageError, ParameterError, one_line
from mwdn.io.images import READABLE, read_frame
from mwdn.io.listing import pictures_in


def list_photographs(folder: Path, seed: int, known: list[str] | None = None) -> list[str]:
    """Names of the pictures in a folder and its subfolders, in a random order that the seed decides.

    Args:
        folder: hidden files are skipped.
        seed: of the order.
        known: names that are left out.

    Raises:
        ParameterError: there is no such folder, or no picture in it.
    """
    if not folder.is_dir():
        raise ParameterError(
            f"`folder` (`{folder}`) of [pictures] is not a folder. Give the folder of the photographs."
        )
    names = [path.relative_to(folder).as_posix() for path in pictures_in(folder)]
    for name in [name for name in names if name != name.encode(errors="replace").decode()]:
        names.remove(name)  # a session stores names as UTF-8
        warnings.warn(f"`{one_line(name)}` is skipped, because its name is not UTF-8. Rename it.", stacklevel=2)
    if not names:
        raise ParameterError(f"`{folder}` holds no photograph. Readable: {', '.join(sorted(READABLE))}.")
    left = sorted(set(names) - set(known or ()))
    random.Random(seed).shuffle(left)
    return left


def read_photograph(path: Path, size: tuple[int, int]) -> Picture:
    """The largest central part of a photograph with these proportions, at this size (height, width), as coded.

    Raises:
        ImageError: it cannot be read, or holds floats.
    """
    frame = read_frame(path, upright=True)
    if frame.dtype == np.uint16:
        frame = np.rint(frame / 257).astype(np.uint8)
    if frame.dtype != np.uint8:
        raise ImageError(f"`{path}` holds {frame.dtype}; photographs have 8 or 16 bits. Save it as PNG or JPEG.")
    return fit_photograph(frame, size)


def fit_photograph(frame: Picture, size: tuple[int, int]) -> Picture:
    """The largest central part of a photograph (h, w, 1 or 3) with these proportions, at this size (height, width)."""
    import cv2

    height, width = frame.shape[:2]
    scale = min(height / size[0], width / size[1])
    rows, columns = max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)
    top, left = (height - rows) // 2, (width - columns) // 2
    part = np.ascontiguousarray(np.broadcast_to(frame, (height, width, 3))[top : top + rows, left : left + columns])
    how = cv2.INTER_AREA if rows >= size[0] else cv2.INTER_CUBIC
    return part if part.shape[:2] == size else np.asarray(cv2.resize(part, size[::-1], interpolation=how), np.uint8)
