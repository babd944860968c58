"""List captures, and read them as measurements."""

from collections.abc import Iterable, Mapping
from glob import glob
from pathlib import Path
from typing import NamedTuple

import torch

from mwdn.calibration import Calibration
from mwdn.errors import ImageError, ParameterError, ShapeError
from mwdn.io.files import path_resolver
from mwdn.io.listing import FRAMES, enumerate_names, list_folder
from mwdn.types import Measurement


class CaptureList(NamedTuple):
    """Captures, and what was left out.

    Args:
        files: strings instead of paths: a million of them take about 0.2 GB.
        skipped: a sentence for each kind of file that was left out, with its reason.
    """

    files: list[str]
    skipped: list[str]


def list_captures(paths: Iterable[str | Path], *, exclude: Mapping[str, Path] | None = None) -> CaptureList:
    """List files, and the frames in folders in alphabetical order, without duplicates.

    Args:
        paths: files, patterns of files such as ``*.png``, and folders.
        exclude: files that are no captures, by what they are: ``{"PSF": psf, "dark frame": dark}``. Hidden files in
            folders are excluded, too.

    Raises:
        ParameterError: no capture is left, a folder holds none, or no file matches a pattern.
    """
    real = path_resolver()  # the same file may have two names
    others = {real(str(path)): name for name, path in (exclude or {}).items()}
    files: dict[str, None] = {}
    skipped: dict[str, None] = {}
    for path in map(Path, paths):
        listed, notes = list_folder(path) if path.is_dir() else (_matching(path), [])
        kinds = [others.get(real(name)) for name in listed]
        captures = [name for name, kind in zip(listed, kinds, strict=True) if not kind]
        excluded = [f"{Path(name).name} (the {kind})" for name, kind in zip(listed, kinds, strict=True) if kind]
        notes += [f"Skipped {enumerate_names(excluded)}."] if excluded else []
        if not captures and path.is_dir():
            readable = ", ".join(sorted(FRAMES))
            raise ParameterError(" ".join([f"The folder `{path}` holds no capture. Readable: {readable}.", *notes]))
        files |= dict.fromkeys(captures)
        skipped |= dict.fromkeys(notes)
    if not files:
        raise ParameterError(" ".join(["Name at least one capture, or a folder of captures.", *skipped]))
    return CaptureList(list(files), list(skipped))


def _matching(path: Path) -> list[str]:
    """A file; or those that a pattern such as ``*.png`` matches, which not every shell replaces by its files."""
    if str(path).startswith(("http:/", "https:/")):
        raise ParameterError(f"`{path}` is an address, not a file. Download the file, then name it.")
    if not set("*?[") & set(str(path)) or path.exists():
        return [str(path)]
    found = sorted(glob(str(path)))  # noqa: PTH207 - hidden files are left out, as by a shell
    if not found:
        raise ParameterError(f"No file matches `{path}`. Check the pattern; the current folder is `{Path.cwd()}`.")
    return found


def find_captures(paths: Iterable[str | Path], *, exclude: Mapping[str, Path] | None = None) -> list[Path]:
    """The files of `list_captures` as paths."""
    return [Path(path) for path in list_captures(paths, exclude=exclude).files]


def read_capture(path: Path, calibration: Calibration) -> Measurement:
    """Read a raw frame as a measurement, (1, C, H, W).

    Raises:
        MwdnError: the file cannot be read, or does not fit the camera.
    """
    return calibration.correct(calibration.frames.read(path))


def read_captures(paths: Iterable[Path], calibration: Calibration, *, lit: bool = False) -> Measurement:
    """Read raw frames as one batch of measurements, (B, C, H, W).

    Args:
        paths: of the files.
        calibration: the camera's.
        lit: refuse captures without light.

    Raises:
        MwdnError: a file cannot be read, does not fit the camera, is refused, or has other channels than the first.
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
        if lit and measurement.amax() <= 0:
            raise ImageError(f"`{path}`: the sensor saw no light. Leave this capture out.")
        measurements.append(measurement)
    return torch.cat(measurements)
