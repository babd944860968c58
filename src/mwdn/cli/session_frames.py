"""Frames for `mwdn calibrate` that `mwdn capture` has recorded at the start of a session."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mwdn.calibration.frame_format import FrameFormat
from mwdn.cli.photographs import PhotographOptions
from mwdn.data.hdf5 import as_damage, find_rows, open_hdf5, read_attributes
from mwdn.data.pair_writer import PAIR_SUFFIXES
from mwdn.errors import ParameterError
from mwdn.io.images import write_frame
from mwdn.io.listing import list_folder

_ADVICE = "Record it again: `mwdn capture`, with `frames` of [point]."


@dataclass(frozen=True)
class BenchFrames:
    """Pictures of a point source, and how they and the others were taken.

    Args:
        pictures: of the point source.
        photographs: frames of other kinds, and exposures.
        frames: format of all of them.
    """

    pictures: list[Path]
    photographs: PhotographOptions
    frames: FrameFormat


@contextmanager
def bench_frames(given: BenchFrames, known_dark: Path | None = None) -> Iterator[BenchFrames]:
    """The frames as they are, or those of a session: of its file, or of the only file of pairs in a folder.

    Those of a session are in a temporary folder until the end of the ``with`` statement.

    Args:
        given: by the options.
        known_dark: dark frame of the camera file to change; a session's own replace it.

    Raises:
        ParameterError: the session has none, or options give what it has.
        ImageError: it is damaged.
    """
    path = _session(given.pictures)
    if path is None:
        yield given
        return
    options = given.photographs
    has_dark = options.dark_files not in ((), (known_dark,))
    times = options.exposures or options.dark_exposures or options.capture_exposure is not None
    if has_dark or times or options.distances or options.field:
        raise ParameterError(
            f"`{path}` has its own `exposures`, `dark` frames and `capture_exposure`, one distance and no `field`. "
            "Leave those options out."
        )
    with TemporaryDirectory(prefix="mwdn-frames-") as folder:
        yield _extracted(path, Path(folder), given)


def _session(pictures: Sequence[Path]) -> Path | None:
    """The session's file, if these pictures are one."""
    if len(pictures) != 1:
        return None
    (path,) = pictures
    if path.is_dir() and not list_folder(path)[0]:
        files = sorted(each for each in path.iterdir() if each.suffix.lower() in PAIR_SUFFIXES)
        return files[0] if len(files) == 1 else None
    return path if path.suffix.lower() in PAIR_SUFFIXES else None


def _extracted(path: Path, folder: Path, given: BenchFrames) -> BenchFrames:
    numbered = (f"{kind}-{number}" for number in range(1, 5) for kind in ("point", "dark"))
    with open_hdf5(path, _ADVICE) as file:
        attributes = read_attributes(path, file, _ADVICE)
        groups: dict[str, list[Path]] = {}
        exposures_ms: dict[str, float] = {}
        for name in ("dark", "white", "half", *numbered):
            rows = find_rows(path, file, f"calibration/{name}/measurement", _ADVICE)
            if rows is not None:
                groups[name] = _written(path, rows, folder / name)
                exposures_ms[name] = 1000 * _exposure_s(path, file, name)
    count = sum(f"dark-{number}" in groups and f"point-{number}" in groups for number in range(1, 5))
    if not count or not {"dark", "white", "half"} <= groups.keys():
        raise ParameterError(
            f"`{path}` has no frames of a point source. Set `frames` of [point] in the recipe before the session "
            "starts (`mwdn capture RECIPE --point.frames 8`), or photograph one: `mwdn calibrate --help`."
        )
    points, darks = ([f"{kind}-{number}" for number in range(1, count + 1)] for kind in ("point", "dark"))
    times, usual = tuple(exposures_ms[name] for name in points), exposures_ms["dark"]
    photographs = replace(
        given.photographs,
        exposures=times,
        dark=tuple(file for name in (*darks, "dark") for file in groups[name]),
        dark_exposures=(*times, usual),
        capture_exposure=usual,
    )
    if not photographs.flat:  # the mask is in front of the sensor: no flat field
        darkest = min(("dark", *darks), key=lambda name: exposures_ms[name])  # least of the room's light and its noise
        flat, flat_dark = (*groups["white"], *groups["half"]), tuple(groups[darkest])
        photographs = replace(photographs, flat=flat, flat_dark=flat_dark, flat_through_mask=True)
    frames = given.frames.completed(attributes.get("bit_depth"), attributes.get("mosaic"), of=f"`{path}`")
    return BenchFrames([file for name in points for file in groups[name]], photographs, frames)


def _written(path: Path, rows: Any, folder: Path) -> list[Path]:  # noqa: ANN401
    """Write the frames of a group as files; returns their paths."""
    folder.mkdir()
    files = [folder / f"{folder.name}-{number:03d}.png" for number in range(len(rows))]
    for number, file in enumerate(files):
        with as_damage(f"`calibration/{folder.name}` {number} of `{path}` cannot be read", _ADVICE):
            frame = rows[number]
        write_frame(file, frame)
    return files


def _exposure_s(path: Path, file: Any, name: str) -> float:  # noqa: ANN401
    with as_damage(f"`calibration/{name}` of `{path}` has no exposure", _ADVICE):
        return float(file[f"calibration/{name}"].attrs["exposure_s"])
