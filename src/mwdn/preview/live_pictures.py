"""Live frames to pictures, with the settings of the moment."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import Any

import torch

from mwdn.calibration import Calibration, FrameFormat
from mwdn.capture.source import CameraFrame
from mwdn.errors import MwdnError, ParameterError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.preview.live_encoding import brightest, encode_jpeg
from mwdn.preview.live_settings import LiveSettings
from mwdn.preview.result import Result
from mwdn.solvers.alignment import align, has_detail
from mwdn.solvers.warm_start import WarmStart
from mwdn.types import Measurement, Scene


@dataclass(frozen=True, eq=False)
class LivePicture:
    """A frame and its reconstruction.

    Args:
        frame: as the camera delivered it.
        measurement: (1, C, H, W).
        scene: likewise, in the colours of the camera.
        settings: with which it was made.
        calibration: of the camera, with what the camera says about its frames.
        has_ambient: whether a frame of the room's light was subtracted.
        wrong: what is wrong with the frame.
    """

    frame: CameraFrame
    measurement: Measurement
    scene: Scene
    settings: LiveSettings
    calibration: Calibration
    has_ambient: bool = False
    wrong: str = ""

    def encode(self) -> tuple[bytes, bytes]:
        """JPEGs of the measurement and the scene."""
        look = self.settings.look
        scene = look.balance(self.scene, self.calibration.light, self.calibration.white_balance)
        measurement = encode_jpeg(self.measurement, brightest(self.measurement))
        return measurement, encode_jpeg(scene, brightest(scene) / 2**look.exposure)

    def result(self) -> Result:
        """As a finished reconstruction, with the frame's metadata in its report."""
        frame, camera = self.frame, self.calibration
        report = {
            "method": self.settings.method,
            "options": self.settings.options,
            "psf_hash": camera.psf_hash,
            "height": self.scene.shape[-2],
            "width": self.scene.shape[-1],
            "number": frame.number,
            "timestamp": frame.timestamp,
            "exposure_s": finite(frame.exposure_s),
            "gain": finite(frame.gain),
            "bit_depth": frame.bit_depth,
            "mosaic": frame.mosaic,
        }
        return Result(self.measurement, self.scene, camera.light, camera.white_balance, report, frame=frame.array)


def finite(value: float) -> float | None:
    """The number; ``None``, for JSON, if it is NaN or infinity."""
    return value if math.isfinite(value) else None


class LivePictures:
    """Reconstructs frames.

    Args:
        calibration: of the camera.
        settings: at first.
        device: see `Reconstructor`.
        count: called with a stage and its seconds, from any thread.

    Attributes:
        refused: why a wish was refused.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: LiveSettings,
        device: str | None = None,
        *,
        count: Callable[[str, float], None] = lambda stage, seconds: None,
    ) -> None:
        self._given, self.settings, self.device, self.count = calibration, settings, device, count
        self.refused = ""
        self._lock = Lock()  # of what `change` writes while a frame is prepared
        self._takes_ambient: bool | None = None
        self._reconstruct: Reconstructor | None = None
        self._used = settings
        self._ambient: CameraFrame | None = None
        self._format: tuple[int, str | None] = 0, None  # bit depth and mosaic of the frames that `_reconstruct` takes

    def change(self, message: dict[str, Any]) -> None:
        """Take over the settings of a message, from any thread; why one is not possible becomes `refused`."""
        with self._lock:
            self.refused = ""
            self._takes_ambient = message.get("ambient", self._takes_ambient)
            try:
                self.settings = self.settings.changed(message, self._given.light)
            except MwdnError as error:
                self.refused = str(error)

    def begin(self, frame: CameraFrame) -> Callable[[], LivePicture]:
        """Prepare the reconstruction of a frame with the present settings, for one frame at a time.

        Returns:
            A function that makes the picture, at the same time as those of other frames.

        Raises:
            MwdnError: the camera's frames do not fit the calibration, or the method does not fit the camera.
        """
        reconstruct, problem = self._prepared(frame)
        if problem:
            return partial(self._blank, frame, reconstruct.calibration, problem)
        if reconstruct.align:  # the pose of the first frame that shows something holds for those that follow
            with torch.inference_mode(), suppress(MwdnError):  # `_finish` says what is wrong with a frame
                measurement = reconstruct.calibration.correct(frame.array).to(reconstruct.device)
                measurement, _ = reconstruct.without_room_light(measurement)
                if has_detail(measurement).all():
                    self._reconstruct = reconstruct = reconstruct.at(align(measurement, reconstruct.psf))
        finish = partial(self._finish, frame, reconstruct, self._used, has_ambient=self._ambient is not None)
        if isinstance(reconstruct.method, WarmStart):  # each frame needs the result of the one before
            picture = finish()
            return lambda: picture
        return finish

    def _blank(self, frame: CameraFrame, calibration: Calibration, problem: str) -> LivePicture:
        """A black picture for a frame that does not fit the camera."""
        black = torch.zeros(1, calibration.psf.shape[1], *calibration.size)
        return LivePicture(frame, black, black, self._used, calibration, wrong=problem)

    def _finish(
        self, frame: CameraFrame, reconstruct: Reconstructor, settings: LiveSettings, *, has_ambient: bool
    ) -> LivePicture:
        start, wrong, calibration = time.perf_counter(), "", reconstruct.calibration
        try:
            measurement = calibration.correct(frame.array)
        except MwdnError as error:  # a frame of another size must not end the live picture
            return self._blank(frame, calibration, str(error))
        self.count("correct", time.perf_counter() - start)
        start = time.perf_counter()
        try:
            scene = torch.nan_to_num(reconstruct.as_recorded(reconstruct.on_device(measurement)).cpu())
        except ParameterError as error:  # nor must a dark frame
            wrong, scene = str(error), torch.zeros_like(measurement)
        self.count("reconstruct", time.perf_counter() - start)
        shown = measurement.clamp(min=0)
        return LivePicture(frame, shown, scene, settings, calibration, has_ambient=has_ambient, wrong=wrong)

    def _prepared(self, frame: CameraFrame) -> tuple[Reconstructor, str]:
        """The method for the current settings or, if it is refused, the one before; and why the frame does not fit."""
        with self._lock:
            settings, takes_ambient, self._takes_ambient = self.settings, self._takes_ambient, None
        self._choose_ambient(frame, takes_ambient)
        before, frame_format = self._reconstruct, (frame.bit_depth, frame.mosaic)
        if before is not None and frame_format == self._format and settings.is_same_method(self._used):
            self._used = settings
            return before, ""
        try:
            calibration = self._calibration(frame)
        except MwdnError as error:
            if before is None:
                raise
            return before, str(error)
        try:
            self._reconstruct = after = settings.prepare(calibration, self.device)
            self._format, self._used = frame_format, settings
        except MwdnError as error:
            if before is None:
                raise
            after, self._used = before, replace(self._used, look=settings.look)
            with self._lock:
                if self.settings is settings:  # a newer wish is for the next frame
                    self.settings, self.refused = self._used, str(error)
        return after, ""

    def _choose_ambient(self, frame: CameraFrame, is_wanted: bool | None) -> None:
        """Take the frame as that of the room's light, or drop that frame; ``None`` drops it if the exposure changes."""
        if is_wanted is None and (self._ambient is None or _is_alike(self._ambient, frame)):
            return
        if is_wanted is None:
            self.refused = "The exposure has changed: take the frame of the room's light again."
        self._ambient, self._reconstruct = frame if is_wanted else None, None

    def _calibration(self, frame: CameraFrame) -> Calibration:
        """The calibration, with what the camera says about its frames, and the room's light."""
        frames, ambient = self._completed(frame), self._given.ambient
        if self._ambient is not None:
            ambient = self._completed(self._ambient).normalise(self._ambient.array)
        return replace(self._given, frames=frames, ambient=ambient)

    def _completed(self, frame: CameraFrame) -> FrameFormat:
        return self._given.frames.completed(frame.bit_depth, frame.mosaic, of="the camera")


def _is_alike(a: CameraFrame, b: CameraFrame) -> bool:
    """Whether two frames have the same exposure and gain, or the camera does not say."""
    pairs = (a.exposure_s, b.exposure_s), (a.gain, b.gain)
    return all(not math.isfinite(x - y) or math.isclose(x, y, rel_tol=0.01) for x, y in pairs)
