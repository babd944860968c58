"""The first frame after a moment, from a camera whose frames come late or damaged, or that fails."""

import math
import time
import warnings
from collections.abc import Callable

from mwdn.capture.continuation import ROUNDING
from mwdn.capture.recipe import CameraTable
from mwdn.capture.source import CameraFrame, CameraSource
from mwdn.errors import CameraError, ImageError

IN_PROGRESS = 10
"""Largest number of frames that may have a camera's old settings after it was set; a Raspberry Pi's has a few."""

AHEAD_S = 0.1
"""A frame that is later than now, by more than this, has the time of another clock."""

CLOCKS = "Set its clock to this computer's; for `folder:` that of the disk to which frames are written."
"""Advice of the messages about times."""


class Grabber:
    """Frames of a session's camera.

    Args:
        camera: open; opened again if it fails.
        table: its settings, and how often it may fail for one frame.
        skip: frames that are read and not used before each one.
        wait: sleeps for a number of seconds.
    """

    def __init__(self, camera: CameraSource, table: CameraTable, skip: int, wait: Callable[[float], None]) -> None:
        self.camera, self._table, self._skip, self._wait = camera, table, skip, wait

    def configure(self) -> None:
        """Set exposure and gain, as far as the recipe names them."""
        self.camera.configure(self._table.exposure_s or None, self._table.gain if self._table.gain >= 0 else None)

    def first(self) -> CameraFrame:
        """A frame with the camera's settings; frames that were in progress when it was set have its old ones."""
        frame = self.after(time.time())
        for _ in range(IN_PROGRESS):
            wanted = ((frame.exposure_s, self._table.exposure_s), (frame.gain, self._table.gain))
            if not any(value > 0 and abs(now / value - 1) > ROUNDING for now, value in wanted):
                break
            frame = self.after(time.time())
        return frame

    def after(self, shown: float, settle_s: float = 0.0) -> CameraFrame:
        """The first frame whose exposure began so many seconds after a picture was shown (seconds since 1970).

        A camera that fails is opened again; a frame that is damaged is passed over.

        Raises:
            CameraError, ImageError: more than `attempts` failures.
        """
        return self._grab(shown, settle_s, self._skip)

    def another(self) -> CameraFrame:
        """A further frame of the same picture: the next one.

        Raises:
            CameraError, ImageError: as for `after`.
        """
        return self._grab(0.0, 0.0, 0)

    def _grab(self, shown: float, settle_s: float, skip: int) -> CameraFrame:
        failures = 0
        while True:
            try:
                for _ in range(skip):
                    self.camera.read()
                return self._next(shown, settle_s)
            except (CameraError, ImageError) as error:
                failures += 1
                if failures > self._table.attempts:
                    raise
                if isinstance(error, ImageError):
                    warnings.warn(f"{error} The next frame is taken.", stacklevel=2)
                    skip = 0
                    continue
                warnings.warn(f"{error} Opened again, attempt {failures}.", stacklevel=2)
                self._reopen(last=failures == self._table.attempts)
                skip = self._skip

    def _next(self, shown: float, settle_s: float) -> CameraFrame:
        end = time.monotonic() + settle_s + self.camera.timeout_s
        while True:
            frame = self.camera.read()
            if not self.camera.live:
                return frame
            now, exposure_s = time.time(), 0.0 if math.isnan(frame.exposure_s) else frame.exposure_s
            begun = frame.timestamp - exposure_s
            if now < shown:  # the clock was set back: this frame may be of the time before
                shown = now
                continue
            if begun > now + AHEAD_S:
                raise CameraError(
                    f"A frame of {self.camera.name} has a time {begun - now:.1f} s ahead of this computer's. {CLOCKS}"
                )
            if begun >= shown + settle_s:
                return frame
            if time.monotonic() > end + exposure_s:
                raise CameraError(
                    f"The newest frame of {self.camera.name} is {now - begun:.1f} s old, older than the picture on the "
                    f"display. {CLOCKS} A slow camera needs a larger `timeout_s` of [camera]."
                )

    def _reopen(self, *, last: bool) -> None:
        self.camera.close()
        self._wait(1.0)
        try:
            self.camera.open()
            self.configure()
        except CameraError:
            if last:
                raise
