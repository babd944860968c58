"""Guide the exposure while the user adjusts it: measure each new frame of a folder or of a camera."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from mwdn.calibration.exposure import Exposure, measure_exposure
from mwdn.calibration.frame_format import FrameFormat
from mwdn.errors import ImageError, MwdnError
from mwdn.io.listing import list_folder
from mwdn.types import Frame

TRIES = 5
"""Attempts to read a file before it counts as damaged instead of still being written."""


def watch_folder(
    folder: Path, frames: FrameFormat, wait: Callable[[], bool]
) -> Iterator[tuple[str, Frame | ImageError]]:
    """Yield each frame that is written to a folder from now on, and first the newest of those that are there.

    For a file that stays unreadable its error is yielded in place of the frame.

    Args:
        folder: of the frames.
        frames: their format.
        wait: called between two looks at the folder; false ends the watch.

    Raises:
        ImageError: the folder does not exist.
    """
    if not folder.is_dir():
        raise ImageError(f"`{folder}` must be a folder to which the camera's program writes frames. Make it first.")
    done: dict[str, tuple[int, int]] = {}
    failed: dict[str, int] = {}
    is_first = True
    while True:
        states = _states(folder)
        new = [path for path, state in states.items() if done.get(path) != state]
        for path in new[-1:] if is_first else new:
            frame: Frame | ImageError
            try:
                frame = frames.read_stored(path)[0]
            except ImageError as error:
                failed[path] = failed.get(path, 0) + 1
                if failed[path] < TRIES:  # it may still be written
                    states.pop(path)
                    continue
                frame = error
            failed.pop(path, None)
            yield Path(path).name, frame
        done, is_first = states, False
        if not wait():
            return


def _states(folder: Path) -> dict[str, tuple[int, int]]:
    """Time of modification and size of each frame, the oldest first."""
    states = {}
    for path in list_folder(folder)[0]:
        with contextlib.suppress(OSError):  # removed meanwhile
            status = Path(path).stat()
            states[path] = status.st_mtime_ns, status.st_size
    return dict(sorted(states.items(), key=lambda item: item[1]))


def guide_exposure(
    frames: Iterable[tuple[str, Frame | ImageError]], format: FrameFormat, *, exposure_ms: float | None = None
) -> Iterator[tuple[str, Exposure | None]]:
    """Say of each frame how it is exposed, and which exposure to use next.

    Args:
        frames: names and frames (H, W, C), from `watch_folder` or any camera.
        format: of the frames.
        exposure_ms: of all frames, if it is known and stays the same.

    Yields:
        A sentence and the measurement; ``None`` for a frame that cannot be measured.
    """
    format = format.encoding
    for name, frame in frames:
        exposure = None
        try:
            if isinstance(frame, ImageError):
                raise frame
            exposure = measure_exposure(frame, format)
            sentence = _advice(exposure, format.possible_bit_depth(frame), exposure_ms)
        except MwdnError as error:
            sentence = f"left out. {error}"
        yield f"{name}: {sentence}", exposure


def _advice(exposure: Exposure, bits: int | None, exposure_ms: float | None) -> str:
    share = exposure.saturated / exposure.pixels
    if exposure.is_good:
        advice = "well exposed"
    elif bits and exposure.saturated == 0:
        advice = f"use {exposure.next(exposure_ms)}, or give the sensor's bits: --bit-depth {bits}"
    else:
        advice = f"use {exposure.next(exposure_ms)}"
    return f"peak {exposure.peak:.0%}, saturated {share:.2%} of the pixels; {advice}"
