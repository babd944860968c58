"""A folder as a camera, into which another program writes frames: tethered cameras, vendors' viewers, scripts."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mwdn.calibration import FrameFormat
from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource
from mwdn.errors import CameraError, ImageError
from mwdn.io.listing import FRAMES
from mwdn.io.raw import Mosaic

POLL_S = 0.05
"""Seconds between two scans of the folder."""

PATIENCE = 20
"""Scans of an unchanged file that cannot be read before it counts as damaged: 1 s."""


class WatchedFolder(CameraSource):
    """Frames from files, the oldest first; each file once.

    A file is complete when two scans find the same size and time, and it can be decoded.

    Args:
        folder: not searched for subfolders; hidden files are skipped, so a program can write to ``.name`` and rename.
        bit_depth: of the sensor; by default that of the files' type.
        mosaic: colours of a 2 x 2 cell of raw frames; a camera's raw file says its own.
        existing: also read the files that are there when the folder is opened.
        timeout_s: seconds to wait for a file; two scans take place in any case.
        wait: sleeps for a number of seconds.

    Raises:
        ParameterError: a wrong bit depth.
    """

    may_pause = True

    def __init__(
        self,
        folder: str | Path,
        *,
        bit_depth: int | None = None,
        mosaic: Mosaic | None = None,
        existing: bool = True,
        timeout_s: float = TIMEOUT_S,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(f"folder:{folder}", timeout_s)
        self.folder, self.existing = Path(folder), existing
        self._format, self._wait = FrameFormat(bit_depth=bit_depth, mosaic=mosaic), wait
        self._seen: set[tuple[str, int]] | None = None
        self._number = 0

    def open(self) -> None:
        """Begin to watch; files that were read before `close` are not read again."""
        if not self.folder.is_dir():
            raise CameraError(f"`{self.folder}` is not a folder to watch. Make it, or check the name.")
        if self._seen is None:
            self._seen = set() if self.existing else set(self._states())

    def close(self) -> None:
        """Nothing is held open."""

    def read(self) -> CameraFrame:
        """Wait for the next file.

        Raises:
            CameraError: no new file in time.
            ImageError: the file is damaged or no frame; the next call goes on with the next file.
        """
        if self._seen is None:
            raise self.not_open()
        before: dict[tuple[str, int], tuple[int, int]] = {}  # size, and how often it was the same
        looks = max(int(self.timeout_s / POLL_S), 2)
        while looks > 0:
            now = self._states()
            for key in sorted(now.keys() - self._seen, key=lambda key: (key[1], key[0])):
                size, same = before.get(key, (-1, 0))
                before[key] = now[key], same + 1 if size == now[key] else 0
                if size != now[key] or not size:
                    continue
                frame = self._frame(key, last=before[key][1] >= PATIENCE)
                if frame is not None:
                    return frame
            looks -= 1
            self._wait(POLL_S)
        raise self.silent()

    def _states(self) -> dict[tuple[str, int], int]:
        """Size of each file by name and time of the last change."""
        states = {}
        try:
            with os.scandir(self.folder) as entries:
                for entry in entries:
                    if not entry.name.startswith(".") and Path(entry.name).suffix.lower() in FRAMES:
                        status = entry.stat()
                        states[entry.name, status.st_mtime_ns] = status.st_size
        except OSError as error:
            if not isinstance(error, FileNotFoundError) or not self.folder.is_dir():  # else a file has been removed
                raise CameraError(f"`{self.folder}` cannot be read any more: {error.strerror}. Restore it.") from error
        return states

    def _frame(self, key: tuple[str, int], *, last: bool) -> CameraFrame | None:
        """Read a file that is stable; ``None`` if it is not complete yet."""
        try:
            array, frames = self._format.read_stored(self.folder / key[0])
        except ImageError:
            if not last:
                return None
            self._done(key)
            raise
        self._done(key)
        if array.dtype not in (np.uint8, np.uint16):
            raise ImageError(f"`{self.folder / key[0]}` holds {array.dtype}; raw frames have 8 or 16 bits.")
        bits = frames.bit_depth or 8 * array.dtype.itemsize
        return CameraFrame(
            array=array, bit_depth=bits, mosaic=frames.mosaic, timestamp=key[1] / 1e9, number=self._number - 1
        )

    def _done(self, key: tuple[str, int]) -> None:
        if self._seen is not None:
            self._seen.add(key)
        self._number += 1
