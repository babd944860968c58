"""Pictures played on the display of the simulated rig: a folder of pictures, or a video."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.capture.photograph_list import fit_photograph, read_photograph
from mwdn.capture.screen import Picture
from mwdn.errors import ImageError, ParameterError
from mwdn.io.images import READABLE
from mwdn.io.listing import pictures_in


@dataclass(frozen=True, kw_only=True)
class PlaylistOptions:
    """What a display plays.

    Args:
        pictures: a folder of pictures, or a video; nothing if empty.
        picture_s: seconds for which each picture of a folder is shown; a video has its own rate.

    Raises:
        ParameterError: ``picture_s`` is not positive.
    """

    pictures: str = ""
    picture_s: float = 2.0

    def __post_init__(self) -> None:
        if not self.picture_s > 0:
            raise ParameterError(f"`picture_s` ({self.picture_s}) must be positive: seconds for each picture.")


class Playlist(ABC):
    """Pictures that are shown one after the other in a loop, which starts with the first call of `entry`.

    Args:
        size: height and width of the display.
        count: of the pictures.
        seconds: for which each is shown.
        clock: seconds.
    """

    def __init__(
        self, size: tuple[int, int], count: int, seconds: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.size, self.count, self.seconds, self._clock = size, count, seconds, clock
        self._start: float | None = None

    @property
    def entry(self) -> int:
        """Number of the picture that is shown now."""
        if self._start is None:
            self._start = self._clock()
        return int((self._clock() - self._start) / self.seconds) % self.count

    @abstractmethod
    def read(self, entry: int) -> Picture:
        """A picture (H, W, 3) of the display's size.

        Raises:
            ImageError: it cannot be read.
        """


class PictureFolder(Playlist):
    """The pictures of a folder in alphabetical order."""

    def __init__(self, folder: Path, size: tuple[int, int], seconds: float, **clock: Any) -> None:  # noqa: ANN401
        self.paths = pictures_in(folder, subfolders=False)
        if not self.paths:
            raise ParameterError(f"`pictures` ({folder}) holds no picture. Readable: {', '.join(sorted(READABLE))}.")
        super().__init__(size, len(self.paths), seconds, **clock)

    def read(self, entry: int) -> Picture:
        """One of the pictures, its largest central part with the display's proportions."""
        return read_photograph(self.paths[entry], self.size)


class Video(Playlist):
    """A video at its own rate; frames for which there is no time are skipped."""

    def __init__(self, path: Path, size: tuple[int, int], **clock: Any) -> None:  # noqa: ANN401
        self.path, self._position = path, 0
        self._video: Any = self._open()
        import cv2

        count = int(self._video.get(cv2.CAP_PROP_FRAME_COUNT))
        rate = float(self._video.get(cv2.CAP_PROP_FPS))
        if not self._video.isOpened() or count < 1 or not 0 < rate < 1000:
            raise ImageError(f"`{path}` is neither a folder of pictures nor a video that can be read.")
        super().__init__(size, count, 1 / rate, **clock)

    def _open(self) -> Any:  # noqa: ANN401
        import cv2

        return cv2.VideoCapture(str(self.path))

    def read(self, entry: int) -> Picture:
        """One frame, its largest central part with the display's proportions."""
        if entry < self._position:  # restart the video
            self._video, self._position = self._open(), 0
        while self._position < entry and self._video.grab():
            self._position += 1
        done, frame = self._video.read()
        if not done and self._position:  # fewer frames than the header states
            self.count, self._position, self._video = self._position, 0, self._open()
            done, frame = self._video.read()
        self._position += 1
        if not done:
            raise ImageError(f"`{self.path}` cannot be read. Convert the video to another format.")
        return fit_photograph(np.ascontiguousarray(frame[..., ::-1]), self.size)


def open_playlist(options: PlaylistOptions, size: tuple[int, int]) -> Playlist | None:
    """A folder of pictures or a video; ``None`` if none is named.

    Args:
        options: which.
        size: height and width of the display.

    Raises:
        ParameterError: no such file or folder, or no picture in it.
        ImageError: the video cannot be read.
    """
    if not options.pictures:
        return None
    path = Path(options.pictures)
    if path.is_dir():
        return PictureFolder(path, size, options.picture_s)
    if not path.is_file():
        raise ParameterError(f"`pictures` ({path}) must be a folder of pictures or a video, but there is none.")
    return Video(path, size)
