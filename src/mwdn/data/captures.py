"""Real captures: where they are, and as measurements."""

import os
from collections.abc import Iterable
from pathlib import Path

import torch

from mwdn.calibration import Calibration
from mwdn.errors import ParameterError, ShapeError
from mwdn.io.images import READABLE
from mwdn.types import Measurement


def list_captures(paths: Iterable[str | Path], *, apart: Iterable[Path | None] = ()) -> list[str]:
    """Files as named, and every readable file of each folder, in the order of their names; each once.

    As strings: a million of them take about 0.2 GB.

    Args:
        paths: files and folders.
        apart: files that are no captures where a folder holds them: the PSF, the dark frame. Hidden ones are none.

    Raises:
        ParameterError: nothing was named, or a folder holds no picture.
    """
    found: list[str] = []
    others = {path.resolve() for path in apart if path is not None}
    for path in map(Path, paths):
        inside = _inside(path, others) if path.is_dir() else [str(path)]
        if not inside:
            raise ParameterError(f"The folder `{path}` holds no capture. Readable: {', '.join(sorted(READABLE))}.")
        found += inside
    if not found:
        raise ParameterError("Name at least one capture, or a folder of captures.")
    return list(dict.fromkeys(found))


def _inside(folder: Path, others: set[Path]) -> list[str]:
    """The captures of a folder. What it is asked of a file is in the folder's own entry, but for links."""
    beside = {path.name for path in others if path.parent == folder.resolve()}

    def is_capture(entry: os.DirEntry[str]) -> bool:
        if entry.name.startswith(".") or Path(entry.name).suffix.lower() not in READABLE or not entry.is_file():
            return False
        return Path(entry.path).resolve() not in others if entry.is_symlink() else entry.name not in beside

    start = str(folder / "x").removesuffix("x")
    with os.scandir(folder) as entries:
        return [start + name for name in sorted(entry.name for entry in entries if is_capture(entry))]


def find_captures(paths: Iterable[str | Path], *, apart: Iterable[Path | None] = ()) -> list[Path]:
    """The same as `list_captures`, as paths."""
    return [Path(path) for path in list_captures(paths, apart=apart)]


def read_capture(path: Path, calibration: Calibration) -> Measurement:
    """Read a raw frame as a measurement, (1, C, H, W).

    Raises:
        MwdnError: it cannot be read, or does not fit the camera.
    """
    return calibration.correct(calibration.frames.read(path))


def read_captures(paths: Iterable[Path], calibration: Calibration) -> Measurement:
    """Read raw frames as one batch of measurements, (B, C, H, W).

    Raises:
        MwdnError: one cannot be read, does not fit the camera, or has other channels than the first.
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
                "Take all in one mode of the camera."
            )
        measurements.append(measurement)
    return torch.cat(measurements)
