"""Record raw frames with their metadata to one file, and play such a file as a camera."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource, check_like
from mwdn.data.hdf5 import (
    add_rows,
    as_damage,
    find_rows,
    open_hdf5,
    open_hdf5_header,
    read_attributes,
    write_row,
)
from mwdn.data.journal import Growing, create_growing
from mwdn.errors import CameraError, ImageError, shown
from mwdn.io.files import as_image_error

COLUMNS = {"exposure_s": "f8", "gain": "f8", "timestamp": "f8", "number": "i8", "dropped": "i8"}
"""Metadata of each frame, and their types in a file."""

ROWS = ("frames", "measurement")
"""Data sets of raw frames that can be played: those of a recording, and of captured pairs."""

MAX_PAUSE_S = 3600.0
"""Longest wait for a frame of a recording. A clock that was set meanwhile, as a Raspberry Pi's after its start, puts
years between two timestamps."""

_ADVICE = "Record it again."


class Recorder:
    """Writes frames to a file, from `record`."""

    def __init__(self, growing: Growing, commit_every: int) -> None:
        self._growing, self._every, self._since = growing, commit_every, 0
        self._first: CameraFrame | None = None
        self._rows: FrameRows | None = None

    def __len__(self) -> int:
        return 0 if self._rows is None else len(self._rows)

    def append(self, frame: CameraFrame) -> None:
        """Add a frame. With ``commit_every`` 1 it is on the disk when this returns.

        Raises:
            CameraError: its array is not as `CameraFrame` says, or its size, type, bit depth or mosaic differs from
                the first frame's.
            ImageError: the disk is full. The frames of earlier commits are kept.
        """
        if self._first is None:
            _check_array(frame)
            self._first = frame
            set_format(self._growing.file.attrs, frame)
            self._rows = FrameRows(self._growing.file, "frames", "frame_data", frame)
        check_like(frame, self._first, "The camera")
        with as_image_error(self._growing.path, f" at frame {len(self) + 1:,}"):
            if self._rows is not None:
                self._rows.append(frame)
            self._since += 1
            if self._since >= self._every:
                self.commit()
            self._growing.disk.check()

    def commit(self) -> None:
        """Make all frames so far permanent."""
        self._since = 0
        self._growing.commit()


@contextmanager
def record(path: str | Path, *, camera: str = "", commit_every: int = 1) -> Iterator[Recorder]:
    """Record frames: ``with record("frames.h5") as recorder: recorder.append(camera.read())``.

    Whatever ends the process, all committed frames stay.

    Args:
        path: a new file, ending in .h5.
        camera: name of the camera, stored.
        commit_every: frames between two commits. Each waits for the disk, a few milliseconds on an SSD; a larger number
            suits fast cameras.

    Raises:
        ImageError: the file exists, or cannot be written.
    """
    with as_image_error(path), create_growing(Path(path)) as growing:
        growing.file.attrs["camera"] = camera
        recorder = Recorder(growing, max(commit_every, 1))
        try:
            yield recorder
        finally:
            if growing.disk.error is None:
                recorder.commit()


class FrameRows:
    """Raw frames and their metadata as rows of an HDF5 file that is being written.

    Args:
        file: the open `h5py.File`, or a group of it.
        name: of the frames' data set, (N, H, W, C).
        columns: group of their metadata, one data set (N,) for each of `COLUMNS`.
        first: a frame of the format that all have.
    """

    def __init__(self, file: Any, name: str, columns: str, first: CameraFrame) -> None:  # noqa: ANN401
        self.data = add_rows(file, name, first.array.shape, first.array.dtype)
        group = file.require_group(columns)
        self.columns = {key: add_rows(group, key, (), np.dtype(kind)) for key, kind in COLUMNS.items()}

    def __len__(self) -> int:
        return len(self.data)

    def append(self, frame: CameraFrame) -> None:
        """Add a frame."""
        write_row(self.data, frame.array)
        for key, column in self.columns.items():
            write_row(column, getattr(frame, key))


def _check_array(frame: CameraFrame) -> None:
    """Raise a `CameraError` for an array that `Replay` would refuse."""
    shape, dtype = frame.array.shape, frame.array.dtype
    if len(shape) != 3 or shape[2] not in (1, 3) or 0 in shape or dtype.name not in ("uint8", "uint16"):
        raise CameraError(
            f"`array` ({shown(frame.array)}) of a frame must be (H, W, 1 or 3) of uint8 or uint16. For a grey one "
            "(H, W): `array[..., None]`."
        )


def set_format(attributes: Any, frame: CameraFrame) -> None:  # noqa: ANN401
    """Store what all frames have in common: ``bit_depth``, and ``mosaic`` or an empty text."""
    attributes["bit_depth"], attributes["mosaic"] = frame.bit_depth, frame.mosaic or ""


class Replay(CameraSource):
    """Plays a recording, or the measurements of captured pairs, as a camera.

    Args:
        path: an .h5 file from `record` or `mwdn capture`.
        loop: start again at the end.
        realtime: wait between frames as long as between their timestamps, but not if that is more than `MAX_PAUSE_S`;
            otherwise each is there at once.
        timeout_s: has no effect.
        wait: sleeps for a number of seconds.
    """

    live = False

    def __init__(
        self,
        path: str | Path,
        *,
        loop: bool = False,
        realtime: bool = False,
        timeout_s: float = TIMEOUT_S,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(f"replay:{path}", timeout_s)
        self.path, self.loop, self.realtime, self._wait = Path(path), loop, realtime, wait
        self._file: Any = None
        self._number = 0

    def open(self) -> None:
        """Open the file at its first frame.

        Raises:
            ImageError: no such file, damaged, or not a recording.
        """
        self.close()
        file = open_hdf5(self.path, _ADVICE)
        try:
            self._load(file)
        except BaseException:
            file.close()
            raise
        self._file, self._number, self._started = file, 0, time.monotonic()

    def _load(self, file: Any) -> None:  # noqa: ANN401
        data = next(filter(None, (find_rows(self.path, file, name, _ADVICE) for name in ROWS)), None)
        if data is None or data.ndim != 4 or data.dtype not in (np.uint8, np.uint16) or not len(data):
            raise ImageError(f"`{self.path}` holds no raw frames. Give a recording, or pairs of `mwdn capture`.")
        self._data = data
        with open_hdf5_header(self.path, _ADVICE) as header:  # HDF5 alone searches a damaged heap of texts forever
            attributes = read_attributes(self.path, header, _ADVICE)
        with as_damage(f"The metadata of `{self.path}` cannot be read", _ADVICE):
            self._bits = int(attributes.get("bit_depth", 8 * data.dtype.itemsize))
            self._mosaic = str(attributes.get("mosaic", "")) or None
        columns = {key: find_rows(self.path, file, f"frame_data/{key}", _ADVICE) for key in COLUMNS}
        self._columns = {key: column for key, column in columns.items() if column is not None}

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def read(self) -> CameraFrame:
        """The next frame, with the metadata of its recording.

        Raises:
            CameraError: the recording has ended.
            ImageError: it is damaged.
        """
        if self._file is None:
            raise self.not_open()
        if self._number == len(self._data):
            if not self.loop:
                raise CameraError(f"{self.name} has ended, after {len(self._data):,} frames. Play it again: `loop`.")
            self._number, self._started = 0, time.monotonic()
        with as_damage(f"Frame {self._number} of `{self.path}` cannot be read", _ADVICE):
            array = self._data[self._number]
            values = {key: column[self._number].item() for key, column in self._columns.items()}
            played = values.get("timestamp", math.nan) - float(self._columns.get("timestamp", [math.nan])[0])
        self._number += 1
        pause = played - (time.monotonic() - self._started)
        if self.realtime and abs(pause) <= MAX_PAUSE_S:
            self._wait(max(pause, 0.0))
        elif math.isfinite(pause):  # those that follow are played from here on
            self._started = time.monotonic() - played
        frame = {"number": self._number - 1, "timestamp": 0.0, **values}
        return CameraFrame(array=array, bit_depth=self._bits, mosaic=self._mosaic, **frame)  # type: ignore[arg-type]
