"""Frames for `mwdn calibrate` at the start of a session: of a point on the display, a black and a white display.

They are stored in the session's file, each group (K, H, W, C) of `CALIBRATION_GROUP` with its exposure:

| group | display | exposure |
| --- | --- | --- |
| ``point-1``, ``point-2`` ... | a point on black, or a lamp | the shortest, then each `ratio` times the last |
| ``dark-1``, ``dark-2`` ... | black | likewise |
| ``dark`` | black | that of the session's pictures |
| ``white``, ``half`` | white, and grey of half of its light | likewise |

Differences of point and dark frames are the point's light alone: the room's light and the light of black pixels are in
both. The frames of ``white`` and ``half`` are for the sensor's noise (photon transfer); they are no flat field, because
the mask is in front of the sensor.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mwdn.calibration.exposure import ABOVE_PEAK, measure_exposure
from mwdn.calibration.frame_average import average_frames
from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.hot_pixels import find_hot_pixels
from mwdn.capture.captured_pairs import SessionFile
from mwdn.capture.patterns import grey, point
from mwdn.capture.recipe import PointTable
from mwdn.capture.screen import Picture, Screen
from mwdn.capture.source import CameraFrame, CameraSource
from mwdn.errors import CameraError

CALIBRATION_GROUP = "calibration"
"""HDF5 group of a session's file that holds them."""

HALF = 186
"""Level of a display with a gamma of 2.2 that has half of white's light: 255 * 0.5 ** (1 / 2.2)."""

_CONTRAST = 0.1
"""Least peak of the point above a dark display at the shortest exposure, over the full scale."""

_SAME = 0.02
"""Relative difference of exposures that cameras round."""

_TRIES = 12


class Shooting(NamedTuple):
    """Functions of a session to show pictures and grab frames.

    Args:
        camera: of the session; its exposure is changed, and set back in the end.
        screen: pixels and centimetres of the display.
        frame_of: shows a picture and returns the first frame of it.
        grab: the first frame whose exposure began after a moment, in seconds since 1970.
        series: so many frames of the same picture, of which the first is given.
        lamp: switches the lamp on or off, or has a person do it; returns when it is done.
    """

    camera: CameraSource
    screen: Screen
    frame_of: Callable[[Picture], CameraFrame]
    grab: Callable[[float], CameraFrame]
    series: Callable[[CameraFrame, int], list[CameraFrame]]
    lamp: Callable[[bool], None]

    def expose(self, exposure_s: float) -> CameraFrame:
        """Set an exposure, and return the first frame that has it."""
        self.camera.configure(exposure_s=exposure_s)
        return self.grab(time.time())


def record_point(pairs: SessionFile, table: PointTable, shooting: Shooting, *, usual_s: float) -> None:
    """Record the groups that the file does not have yet.

    Args:
        pairs: file of the session.
        table: of the recipe.
        shooting: how to show and grab.
        usual_s: exposure of the session's pictures in seconds.

    Raises:
        CameraError: the exposure cannot be set, or the point is too faint beside the room's light.
    """
    screen, last = shooting.screen, f"dark-{table.exposures}"
    if not table.frames or pairs.has_group(f"{CALIBRATION_GROUP}/{last}"):
        return
    if not math.isfinite(usual_s):
        raise CameraError(
            f"{shooting.camera.name} does not say its exposure, which [point] must change. Set `frames` of [point] to "
            "0, and photograph a point source: `mwdn calibrate --help`."
        )
    black = grey(0, (screen.height_px, screen.width_px))
    series = {}
    for name, level in (("dark", 0), ("white", 255), ("half", HALF)):
        first = shooting.frame_of(np.full_like(black, level))
        series[name] = _series(shooting, first, table.frames)
        _add(pairs, name, series[name], usual_s)
    try:
        shooting.frame_of(black if table.lamp else point(screen, table.size_cm))
        if table.lamp:
            shooting.lamp(True)
        exposures = _exposures(shooting, table, usual_s, hot_pixels(series["dark"]))
        for number, exposure_s in enumerate(exposures, 1):
            _add(pairs, f"point-{number}", _series(shooting, shooting.expose(exposure_s), table.frames), exposure_s)
        if table.lamp:
            shooting.lamp(False)
        shooting.frame_of(black)
        for number, exposure_s in enumerate(exposures, 1):
            frames = _series(shooting, shooting.expose(exposure_s), table.frames)
            if number == 1:
                _check_contrast(pairs, frames[0], table)
            _add(pairs, f"dark-{number}", frames, exposure_s)
    finally:
        shooting.camera.configure(exposure_s=usual_s)


def _series(shooting: Shooting, first: CameraFrame, count: int) -> list[CameraFrame]:
    """The first frame and the next ones, an even number: photon transfer takes pairs."""
    return shooting.series(first, count + count % 2)


def _add(pairs: SessionFile, name: str, frames: list[CameraFrame], exposure_s: float) -> None:
    """Store frames, after a check that they have this exposure.

    Raises:
        CameraError: they have another one: the camera was opened again meanwhile, or does not take this exposure.
    """
    for frame in frames:
        if not abs(frame.exposure_s / exposure_s - 1) <= _SAME:
            raise CameraError(
                f"A frame of {name} has an exposure of {frame.exposure_s:.4g} s instead of {exposure_s:.4g} s. The "
                "same command tries again; for shorter exposures set `ratio` or `exposures` of [point] lower."
            )
    pairs.add_frames(f"{CALIBRATION_GROUP}/{name}", frames, {"exposure_s": exposure_s})


def hot_pixels(dark: list[CameraFrame]) -> npt.NDArray[np.bool_]:
    """(H, W, 1), pixels that are brighter than their surroundings in the dark, and would be taken for the point."""
    format = dark[0].format
    average = average_frames([frame.array for frame in dark], format, kind="dark")
    return find_hot_pixels(average, cell=format.cell)[0, 0, :, :, None].numpy()


def _exposures(shooting: Shooting, table: PointTable, exposure_s: float, hot: npt.NDArray[np.bool_]) -> list[float]:
    """The exposure at which the point's peak is well below saturation, and the longer ones."""
    for _ in range(_TRIES):
        frame = shooting.expose(exposure_s)
        array = np.where(hot, 0, frame.array).astype(frame.array.dtype)
        exposure = measure_exposure(array, FrameFormat(bit_depth=frame.bit_depth))
        longer = min(exposure_s * exposure.factor, table.most_s)
        if exposure.is_good or longer == exposure_s:
            break
        exposure_s = longer
    return [exposure_s * table.ratio**number for number in range(table.exposures)]


def _check_contrast(pairs: SessionFile, dark: CameraFrame, table: PointTable) -> None:
    """Raise an error for a point that is faint compared with the light of a dark display.

    Raises:
        CameraError: it is.
    """
    frames = pairs.frames(f"{CALIBRATION_GROUP}/point-1")
    light = np.mean(frames, axis=0, dtype=np.float64).max(-1) - dark.array.max(-1)
    part = float(np.quantile(light, 1 - ABOVE_PEAK)) / (2**dark.bit_depth - 1)
    if part < _CONTRAST:
        pairs.remove(CALIBRATION_GROUP)
        level = float(dark.array.mean()) / (2**dark.bit_depth - 1)
        reason = f"other light has {level:.0%}: darken the room" if level > _CONTRAST else "it is too faint"
        way_out = "Was the lamp on, and off again?" if table.lamp else "Take a lamp behind a pinhole: `lamp = true`."
        raise CameraError(
            f"The point adds only {max(part, 0):.1%} of the full scale in {dark.exposure_s:.3g} s; {reason}. {way_out} "
            "Or photograph it on your own, `frames = 0` in [point]: `mwdn calibrate --help`."
        )
