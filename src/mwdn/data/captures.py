"""List captures, and read them as measurements."""

import os
from collections.abc import Iterable
from pathlib import Path

import torch

from mwdn.calibration import Calibration
from mwdn.errors import ParameterError, ShapeError
from mwdn.io.images import READABLE
from mwdn.types import Measurement


def list_captures(paths: Iterable[str | Path], *, exclude: Iterable[Path | None] = ()) -> list[str]:
    """List files, and the readable files of folders in alphabetical order, without duplicates.

    Strings instead of paths save memory: a million of them take about 0.2 GB.

    Args:
        paths: files and folders.
        exclude: files in these folders that are not captures: the PSF, the dark frame. Hidden files are excluded too.

    Raises:
        ParameterError: ``paths`` is empty, or a folder holds no capture.
    """
    captures: list[str] = []
    excluded = {path.resolve() for path in exclude if path is not None}
    for path in map(Path, paths):
        files = _list_folder(path, excluded) if path.is_dir() else [str(path)]
        if not files:
            raise ParameterError(f"The folder `{path}` holds no capture. Readable: {', '.join(sorted(READABLE))}.")
        captures += files
    if not captures:
        raise ParameterError("Name at least one capture, or a folder of captures.")
    return list(dict.fromkeys(captures))


def _list_folder(folder: Path, excluded: set[Path]) -> list[str]:
    """The captures in a folder; only links are resolved, as that takes a system call per file."""
    excluded_names = {path.name for path in excluded if path.parent == folder.resolve()}

    def is_capture(entry: os.DirEntry[str]) -> bool:
        if entry.name.startswith(".") or Path(entry.name).suffix.lower() not in READABLE or not entry.is_file():
            return False
        return Path(entry.path).resolve() not in excluded if entry.is_symlink() else entry.name not in excluded_names

    start = str(folder / "x").removesuffix("x")
    with os.scandir(folder) as entries:
        return [start + name for name in sorted(entry.name for entry in entries if is_capture(entry))]


def find_captures(paths: Iterable[str | Path], *, exclude: Iterable[Path | None] = ()) -> list[Path]:
    """`list_captures` as paths."""
    return [Path(path) for path in list_captures(paths, exclude=exclude)]


def read_capture(path: Path, calibration: Calibration) -> Measurement:
    """Read a raw frame as a measurement, (1, C, H, W).

    Raises:
        MwdnError: the file cannot be read, or does not fit the camera.
    """
    return calibration.correct(calibration.frames.read(path))


def read_captures(paths: Iterable[Path], calibration: Calibration) -> Measurement:
    """Read raw frames as one batch of measurements, (B, C, H, W).

    Raises:
        MwdnError: a file cannot be read, does not fit the camera, or has other channels than the first.
    """
    measurements: list[Measurement] = []
    for path in paths:
        try:
            measurement = read_capture(path, calibration)
        except ShapeError as error:
            raise ShapeError(f"`{path}`: {error}") from error
        if measurements and measurement.shape != measurements[0].shape:
            channels = measurements[0].shape[1]
            raise ShapeError(
                f"`{path}` ({measurement.shape[1]} channels) must have as many as the captures before it ({channels}). "
                "Take all captures in the same mode of the camera."
            )
        measurements.append(measurement)
    return torch.cat(measurements)
