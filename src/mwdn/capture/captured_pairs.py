"""Files of captured pairs: raw frames, the pictures as displayed, and all data for the later alignment.

`mwdn.data.PairFile` reads it at any time, also while it grows. docs/capture.md lists its content.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from mwdn.capture.recording import COLUMNS, FrameRows, set_format
from mwdn.capture.screen import Picture
from mwdn.capture.source import CameraFrame
from mwdn.data.hdf5 import add_rows, as_damage, find_rows, open_hdf5, write_row
from mwdn.data.journal import Growing, create_growing, open_growing
from mwdn.data.pair_writer import FORMAT_VERSION, PAIR_PARTS, VERSION_KEY
from mwdn.errors import ImageError, ParameterError
from mwdn.io.files import as_image_error

NAME_BYTES = 255
"""Limit of the bytes of a photograph's name, as for a file name."""

_ADVICE = "Start a new file: another name for `out`."

Light = npt.NDArray[np.uint16]
"""(h, w, 3), linear light; 65,535 is the display's white."""


def displayed_light(picture: Picture, gamma: float) -> Light:
    """The light of a picture on a display whose light is the coded number to the power ``gamma``."""
    levels = np.rint((np.arange(256) / 255) ** gamma * 65535).astype(np.uint16)
    return levels[picture]


class SessionFile:
    """A file of pairs that grows, from `create_captured` or `open_captured`."""

    def __init__(self, growing: Growing) -> None:
        self._growing, self._file = growing, growing.file
        self._rows: FrameRows | None = None

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._growing.path

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the file: display, camera, format of the frames."""
        return dict(self._file.attrs)

    @property
    def kinds(self) -> dict[str, tuple[int | str, ...]]:
        """Height, width, channels and type of ``measurement`` and ``scene``."""
        return {name: (*self._file[name].shape[1:], str(self._file[name].dtype)) for name in PAIR_PARTS}

    def set_attributes(self, values: Mapping[str, Any]) -> None:
        """Add attributes, and make everything so far permanent."""
        with self._disk():
            self._file.attrs.update(values)
            self._growing.commit()

    def __len__(self) -> int:
        return len(self._file["measurement"])

    @property
    def names(self) -> list[str]:
        """Photograph of each pair."""
        return self._texts("photograph")

    @property
    def planned(self) -> list[str]:
        """Photographs in the order of the session."""
        return self._texts("planned")

    def _texts(self, name: str) -> list[str]:
        with as_damage(f"`{name}` of `{self.path}` cannot be read", _ADVICE):
            return [text.decode() for text in self._file[name]]

    def plan(self, names: Sequence[str]) -> None:
        """Add photographs to the end of the order."""
        for name in names:
            if len(name.encode()) > NAME_BYTES:
                raise ParameterError(f"`{name[:80]}...` has more than {NAME_BYTES} bytes. Rename the photograph.")
        data = self._file["planned"]
        with self._disk():
            before = len(data)
            data.resize(before + len(names), axis=0)
            data[before:] = [name.encode() for name in names]
            self._growing.commit()

    def append(self, frame: CameraFrame, light: Light, name: str) -> None:
        """Add a pair. When this returns, the pair is on the disk and has been verified by reading it.

        Raises:
            ImageError: the disk is full, or what was read back differs. The pairs before are kept.
        """
        with self._disk(f" at pair {len(self) + 1:,}"):
            if self._rows is None:
                self._rows = FrameRows(self._file, "measurement", "frame_data", frame)
            self._rows.append(frame)
            write_row(self._file["scene"], light)
            write_row(self._file["photograph"], name.encode())
            self._growing.commit()
        self._verify(frame, light)

    def _verify(self, frame: CameraFrame, light: Light) -> None:
        """Read the last pair as another process does."""
        with open_hdf5(self.path, _ADVICE) as file:
            complete = len(file["measurement"]) == len(file["scene"]) == len(file["photograph"]) == len(self)
            same = complete and np.array_equal(file["measurement"][-1], frame.array)
            if not (same and np.array_equal(file["scene"][-1], light)):
                raise ImageError(
                    f"`{self.path}`: pair {len(self):,} is not on the disk as it was written. Check the disk."
                )

    def add_pattern(self, name: str, frames: Sequence[CameraFrame], lights: Sequence[Light]) -> None:
        """Add frames of a pattern, and the pattern as displayed, replacing earlier ones.

        Args:
            name: of the pattern.
            frames: one for each light.
            lights: as displayed.
        """
        place = f"patterns/{name}"
        with self._disk():
            self._delete(place)
            group = self._file.require_group(place)
            rows = FrameRows(group, "measurement", "frame_data", frames[0])
            scenes = add_rows(group, "scene", lights[0].shape, lights[0].dtype)
            for frame, light in zip(frames, lights, strict=True):
                rows.append(frame)
                write_row(scenes, light)
            self._growing.commit()

    def has_pattern(self, name: str) -> bool:
        """Whether frames of a pattern are there."""
        return self.has_group(f"patterns/{name}")

    def add_frames(self, place: str, frames: Sequence[CameraFrame], attributes: Mapping[str, float]) -> None:
        """Add a group of frames with attributes of its own, replacing an earlier one."""
        with self._disk():
            self._delete(place)
            group = self._file.require_group(place)
            group.attrs.update(attributes)
            rows = FrameRows(group, "measurement", "frame_data", frames[0])
            for frame in frames:
                rows.append(frame)
            self._growing.commit()

    def frames(self, place: str) -> npt.NDArray[Any]:
        """(K, H, W, C), the frames of a group."""
        return np.asarray(self._file[place]["measurement"][:])

    def first_settings(self, place: str) -> dict[str, float]:
        """``exposure_s`` and ``gain`` of the first frame of a group; NaN if the camera did not say."""
        with as_damage(f"`{place}` of `{self.path}` cannot be read", _ADVICE):
            data = self._file[place]["frame_data"]
            return {name: float(data[name][0]) for name in ("exposure_s", "gain")}

    def has_group(self, place: str) -> bool:
        """Whether a group is there."""
        return place in self._file

    def remove(self, place: str) -> None:
        """Remove a group."""
        with self._disk():
            self._delete(place)
            self._growing.commit()

    def _delete(self, place: str) -> None:
        if place in self._file:
            del self._file[place]

    def add_references(self, frames: Mapping[str, CameraFrame]) -> None:
        """Add frames of known displays, taken before the next pair."""
        with self._disk():
            for name, frame in frames.items():
                group = self._file.require_group(f"references/{name}")
                FrameRows(group, "measurement", "frame_data", frame).append(frame)
                write_row(add_rows(group, "before", (), np.dtype("i8")), len(self))
            self._growing.commit()

    def references(self, name: str) -> tuple[list[int], list[float]]:
        """Numbers of the pairs before which the reference frames were taken, and the mean of each frame."""
        group = self._file.get(f"references/{name}")
        if group is None:
            return [], []
        return group["before"][:].tolist(), [float(frame.mean()) for frame in group["measurement"]]

    @contextmanager
    def _disk(self, at: str = "") -> Iterator[None]:
        with as_image_error(self.path, at):
            yield
            self._growing.disk.check()


@contextmanager
def create_captured(
    path: Path, first: CameraFrame, scene_size: tuple[int, int], attributes: Mapping[str, Any]
) -> Iterator[SessionFile]:
    """Create a file.

    Args:
        path: ends in .h5, must not exist.
        first: a frame of the session's format.
        scene_size: height and width of pictures as displayed.
        attributes: display, camera.

    Raises:
        ImageError: it exists, or cannot be written.
    """
    with as_image_error(path), create_growing(path) as growing:
        file = growing.file
        file.attrs.update({VERSION_KEY: FORMAT_VERSION, **attributes})
        set_format(file.attrs, first)
        add_rows(file, "scene", (*scene_size, 3), np.dtype(np.uint16))
        for name in ("photograph", "planned"):
            add_rows(file, name, (), h5py.string_dtype("utf-8", NAME_BYTES))
        FrameRows(file, "measurement", "frame_data", first)
        growing.commit()
        yield SessionFile(growing)


@contextmanager
def open_captured(path: Path) -> Iterator[SessionFile]:
    """Open a file to add pairs.

    Raises:
        ImageError: damaged, of another command, or another process writes it.
    """
    with as_image_error(path), open_growing(path) as growing:
        names = ("measurement", "photograph", "planned", "scene", *(f"frame_data/{key}" for key in COLUMNS))
        missing = [name for name in names if find_rows(path, growing.file, name, _ADVICE) is None]
        if missing:
            raise ImageError(f"`{path}` has no {', '.join(missing)}: it is of another command. {_ADVICE}")
        yield SessionFile(growing)
