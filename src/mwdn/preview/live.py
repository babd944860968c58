"""The live picture: one camera and one reconstruction for all viewers; the newest frame wins, nothing queues."""

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from mwdn.calibration import Calibration
from mwdn.capture.source import CameraFrame, CameraSource, SilentCameraError
from mwdn.errors import CameraError, ImageError, MwdnError
from mwdn.preview.limits import RefusedError, for_client
from mwdn.preview.live_pictures import LivePicture, LivePictures, finite
from mwdn.preview.live_recording import LiveRecording
from mwdn.preview.live_settings import CAMERA_SETTINGS, LiveSettings
from mwdn.preview.metrics import Metrics
from mwdn.runtime.devices import select_device
from mwdn.runtime.streams import latest_results
from mwdn.runtime.threads import usable_processors

RATE_FRAMES = 20
"""Frames over which the rate is averaged."""

RETRY_S = 2.0
"""Seconds after which a camera that failed is opened again."""


class _Result(NamedTuple):
    picture: LivePicture
    encoded: tuple[bytes, bytes]
    start: float
    """Seconds since the epoch at which the work began."""


class _Shown(NamedTuple):
    picture: LivePicture
    said: dict[str, Any]
    """About the frame, for JSON."""
    encoded: tuple[bytes, bytes]


class Live:
    """A camera that runs while somebody looks.

    Args:
        camera: opened for the first viewer, closed after the last.
        calibration: of the camera.
        method: see `Reconstructor`; viewers may choose another.
        folder: of recordings.
        device: see `Reconstructor`.
        retry_s: seconds after which a camera that failed is opened again.
    """

    def __init__(
        self,
        camera: CameraSource,
        calibration: Calibration,
        *,
        method: str = "universal-small",
        folder: Path,
        device: str | None = None,
        retry_s: float = RETRY_S,
    ) -> None:
        self.camera, self.calibration, self.metrics = camera, calibration, Metrics()
        self.recording = LiveRecording(folder, camera.name)
        self.pictures = LivePictures(calibration, LiveSettings(method), device, count=self._count)
        self._retry_s, self._device = retry_s, select_device(device)
        self._lock, self._changed = threading.Lock(), threading.Event()
        self._wake: dict[int, Callable[[], None]] = {}
        self._thread: threading.Thread | None = None
        self._pending: dict[str, float] = {}
        self._is_stopped = False
        self._refused = self._unread = ""
        self.newest: bytes | None = None  # message for viewers
        self._shown: _Shown | None = None

    def join(self, wake: Callable[[], None]) -> int:
        """Add a viewer, and start the camera for the first one.

        Args:
            wake: called from another thread when there is a new frame.

        Returns:
            Number of the viewer, for `leave`.
        """
        with self._lock:
            number = max(self._wake, default=0) + 1
            self._wake[number] = wake
            if self._thread is None:
                self._is_stopped, self.newest, self._shown = False, None, None
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()
            return number

    def leave(self, number: int) -> None:
        """Remove a viewer; the camera stops after the last."""
        with self._lock:
            self._wake.pop(number, None)
            if not self._wake:
                self._changed.set()

    @property
    def viewers(self) -> int:
        """Number of viewers."""
        return len(self._wake)

    def snapshot(self) -> LivePicture:
        """The newest frame and its picture.

        Raises:
            RefusedError: there is none.
        """
        if self._shown is None:
            raise RefusedError(409, "The live camera has no picture. Start it first.")
        return self._shown.picture

    def control(self, message: dict[str, Any]) -> None:
        """Follow a message, of `mwdn.preview.live_settings.check_message`."""
        message, self._refused = dict(message), ""
        self._pending |= {name: float(message.pop(name)) for name in CAMERA_SETTINGS if name in message}
        self.recording.is_wanted = message.pop("record", self.recording.is_wanted)
        if message:
            self.pictures.change(message)

    def close(self) -> None:
        """Stop the camera; a recording is complete afterwards."""
        self._is_stopped = True
        self._changed.set()
        thread = self._thread
        if thread is not None:
            thread.join(timeout=20)

    def _run(self) -> None:
        while True:
            failure: Exception | None = None
            try:
                with self.camera, closing(self.recording), closing(self._results()) as results:
                    self._show(results)
            except Exception as error:
                failure = error  # a defect of this package must not end the live picture for good
                self._publish({"error": str(for_client(error, "live picture"))}, b"", b"")
            # When a camera is back, its recording goes on in another file. The next viewer starts none.
            if not (isinstance(failure, CameraError) and self.camera.live):
                self.recording.is_wanted = False
            self._changed.clear()
            if failure and self._wake and not self._is_stopped:
                self._changed.wait(self._retry_s)
            with self._lock:  # somebody may have come since the last one left
                if self._is_stopped or not self._wake:
                    self.recording.is_wanted = False
                    self._thread = None
                    return

    def _frames(self) -> Iterator[CameraFrame]:
        """All frames; settings change between them, and each is recorded if that is wanted."""
        while self._wake and not self._is_stopped:
            self._configure()
            if self.recording.stop():
                self._tell()
            frame = self._read()
            if frame is not None:
                self.recording.add(frame)
                yield frame
        self.recording.close()

    def _read(self) -> CameraFrame | None:
        """The next frame; ``None`` if a camera that may pause has none, or a damaged one."""
        try:
            frame = self.camera.read()
        except (ImageError, SilentCameraError) as error:
            if not self.camera.may_pause:
                raise
            if isinstance(error, ImageError):
                self._unread = str(error)
                self._tell()
            elif self._shown is None:
                self._publish({"error": f"{self.camera.name} has no frame yet."}, b"", b"")
            return None
        self._unread = ""
        return frame

    def _configure(self) -> None:
        """Set what viewers want of the camera; a value that it refuses must not end the picture."""
        while self._pending:
            name, value = self._pending.popitem()
            try:
                self.camera.configure(**{name: value})
            except MwdnError as error:
                self._refused = str(error)

    def _results(self) -> Generator["_Result", None, None]:
        """The newest picture each time.

        On a CPU two frames are in progress, each on half of the processors: 18 frames/s on two processors, against 12
        with one frame on both (docs/performance.md). On a GPU one frame is in progress.
        """
        workers = min(2, usable_processors()) if self._device.type == "cpu" else 1
        threads = max(1, usable_processors() // workers)
        return latest_results(self._begin, self._frames(), workers=workers, threads=threads)

    def _begin(self, frame: CameraFrame) -> Callable[[], "_Result"]:
        start, finish = time.time(), self.pictures.begin(frame)

        def work() -> _Result:
            picture, encoding = finish(), time.perf_counter()
            encoded = picture.encode()
            self._count("encode", time.perf_counter() - encoding)
            return _Result(picture, encoded, start)

        return work

    def _show(self, results: Iterator["_Result"]) -> None:
        times: deque[float] = deque(maxlen=RATE_FRAMES)
        before: CameraFrame | None = None
        dropped = 0
        for picture, encoded, start in results:
            frame = picture.frame
            lost = frame.dropped if before is None else max(frame.number - before.number - 1, 0)
            dropped, before = dropped + lost, frame
            self.metrics.add("mwdn_live_frames_total")
            self.metrics.add("mwdn_live_dropped_total", lost)
            now = time.time()
            times.append(now)
            rate = (len(times) - 1) / (times[-1] - times[0]) if times[-1] > times[0] else 0.0
            # No frame is exposed after it has come: the rig without a rate does not wait for its exposure.
            taken = min(frame.timestamp, start) if self.camera.live and frame.timestamp else start
            said = {"fps": round(rate, 1), "timestamp": taken, "latency_ms": round(1000 * (now - taken))}
            self._shown = _Shown(picture, said | {"dropped": dropped}, encoded)
            self._tell()

    def _tell(self) -> None:
        """Publish the newest picture, and what is to say now."""
        if self._shown is not None:
            picture, said, encoded = self._shown
            self._publish(said | self._about(picture), *encoded)
        elif self._unread:
            self._publish({"error": self._unread}, b"", b"")

    def _about(self, picture: LivePicture) -> dict[str, Any]:
        """For JSON: the frame, and the settings of its picture, which all viewers share."""
        frame, settings = picture.frame, picture.settings
        reasons = (self._refused, self._unread, self.recording.problem, self.pictures.refused, picture.wrong)
        return {
            "number": frame.number,
            "exposure_s": finite(frame.exposure_s),
            "gain": finite(frame.gain),
            "refused": " ".join(filter(None, reasons)),
            "recorded": self.recording.count,
            "recording": self.recording.name,
            "method": settings.method,
            "options": settings.options,
            "align": settings.align,
            "room_light": settings.room_light,
            "stops": settings.look.exposure,
            "white_balance": settings.look.white_balance_text,
            "ambient": picture.has_ambient,
        }

    def _count(self, stage: str, seconds: float) -> None:
        self.metrics.add("mwdn_live_seconds_total", seconds, stage=stage)

    def _publish(self, said: dict[str, Any], measurement: bytes, scene: bytes) -> None:
        said |= {"measurement_bytes": len(measurement), "scene_bytes": len(scene)}
        head = json.dumps(said).encode()
        self.newest = len(head).to_bytes(4, "little") + head + measurement + scene
        with self._lock:
            wake = list(self._wake.values())
        for call in wake:
            call()
