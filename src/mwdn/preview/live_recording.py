"""The recording of a live camera, which viewers switch on and off."""

import time
from contextlib import ExitStack
from itertools import chain, count
from pathlib import Path

from mwdn.capture.recording import Recorder, record
from mwdn.capture.source import CameraFrame
from mwdn.errors import CameraError


class LiveRecording:
    """Frames are appended to a file while a recording is wanted. `close` completes the file.

    Args:
        folder: of the recordings.
        camera: name of the camera, for the file.

    Attributes:
        is_wanted: set by viewers.
        count: frames in the file; ``None`` while nothing is recorded.
        name: of the newest file.
        problem: why the newest frame is not in the file.
    """

    def __init__(self, folder: Path, camera: str) -> None:
        self.folder, self.camera = folder, camera
        self.is_wanted = False
        self.count: int | None = None
        self.name = self.problem = ""
        self._file = ExitStack()
        self._recorder: Recorder | None = None

    def stop(self) -> bool:
        """Complete the file if it is not wanted any more; returns whether it was."""
        if self.is_wanted or self._recorder is None:
            return False
        self.close()
        return True

    def add(self, frame: CameraFrame) -> None:
        """Record a frame if that is wanted. One of another format than the first is left out, see `problem`.

        Raises:
            ImageError: the disk is full. The frames of earlier commits are kept.
        """
        self.problem = ""
        if not self.is_wanted:
            return
        if self._recorder is None:
            self.name = self._free_name()
            self._recorder = self._file.enter_context(record(self.folder / self.name, camera=self.camera))
        try:
            self._recorder.append(frame)
        except CameraError as error:
            self.problem = str(error)
        self.count = len(self._recorder)

    def _free_name(self) -> str:
        """A name by the second, with a number if a recording of this second exists."""
        start = time.strftime("recording-%Y%m%d-%H%M%S", time.gmtime())
        names = chain([f"{start}.h5"], (f"{start}-{number}.h5" for number in count(2)))
        return next(name for name in names if not (self.folder / name).exists())

    def close(self) -> None:
        """Complete the file."""
        self._recorder, self.count, self.problem = None, None, ""
        self._file.close()
