"""Frames of the simulated rig that are exposed once and then repeated: a fast camera that takes no time to simulate."""

from collections.abc import Callable
from typing import Any

import numpy.typing as npt

KEPT_BYTES = 2**27
"""Limit of the bytes of all prepared frames, 218 of 320 x 320 x 3 at 16 bits; further frames are not stored."""

Key = tuple[int, float, float]
"""Entry of the playlist, exposure and gain."""


class PreparedFrames:
    """Frames by the picture, exposure and gain.

    Args:
        count: frames of each picture; 0 keeps none.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._kept: dict[Key, list[npt.NDArray[Any]]] = {}
        self._turn, self._bytes = 0, 0

    def clear(self) -> None:
        """Drop all frames, because the display shows another picture."""
        self._kept, self._turn, self._bytes = {}, 0, 0

    def next(self, key: Key, expose: Callable[[], npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """The next frame; each of a picture's first ``count`` is exposed, then they come again in turn.

        Args:
            key: of the picture.
            expose: makes a frame.
        """
        frames = self._kept.setdefault(key, [])
        if len(frames) < self.count or not self.count:
            frame = expose()
            if self.count and self._bytes + frame.nbytes <= KEPT_BYTES:
                frames.append(frame)
                self._bytes += frame.nbytes
            return frame
        self._turn += 1
        return frames[self._turn % self.count].copy()
