"""The live picture: one camera and one reconstruction for all viewers; the newest frame wins, nothing queues."""

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

from mwdn.calibration import Calibration
from mwdn.capture.recording import Recorder, record
from mwdn.capture.source import CameraFrame, CameraSource, SilentCameraError
from mwdn.errors import CameraError, ImageError, MwdnError
from mwdn.preview.limits import RefusedError
from mwdn.preview.live_pictures import LivePicture, LivePictures, finite
from mwdn.preview.live_settings import CAMERA, LiveSettings
from mwdn.preview.metrics import Metrics
from mwdn.runtime.devices import select_device
from mwdn.runtime.streams import latest_results
from mwdn.runtime.threads import usable_processors

LOG = logging.getLogger("mwdn.preview")

RATE_FRAMES = 20
"""Frames over which the rate is averaged."""

RETRY_S = 2.0
"""Seconds after which a camera that failed is opened again."""


class _Result(NamedTuple):
    picture: LivePicture
    encoded: tuple[bytes, bytes]
    start: float
    """Seconds since the epoch at which the work began."""


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
        self.camera, self.calibration, self.folder, self.metrics = camera, calibration, folder, Metrics()
        self.pictures = LivePictures(calibration, LiveSettings(method), device, count=self._count)
        self._retry_s, self._device = retry_s, select_device(device)
        self._lock, self._changed = threading.Lock(), threading.Event()
        self._wake: dict[int, Callable[[], None]] = {}
        self._thread: threading.Thread | None = None
        self._pending: dict[str, float] = {}
        self._is_recording = self._is_stopped = False
        self._recorded: int | None = None  # frames of the recording that runs
        self._recording = self._refused = self._unrecorded = ""
        self._newest: bytes | None = None
        self._picture: LivePicture | None = None

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
                self._is_stopped, self._newest, self._picture = False, None, None
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

    @property
    def newest(self) -> bytes | None:
        """The newest message for viewers."""
        return self._newest

    def snapshot(self) -> LivePicture:
        """The newest frame and its picture.

        Raises:
            RefusedError: there is none.
        """
        if self._picture is None:
            raise RefusedError(409, "The live camera has no picture. Start it first.")
        return self._picture

    def control(self, message: dict[str, Any]) -> None:
        """Follow a message, of `mwdn.preview.live_settings.check_message`."""
        message, self._refused = dict(message), ""
        self._pending |= {name: float(message.pop(name)) for name in CAMERA if name in message}
        self._is_recording = message.pop("record", self._is_recording)
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
                with self.camera, ExitStack() as recording, closing(self._results(recording)) as results:
                    self._show(results)
            except Exception as error:
                failure = error
                said = str(error)
                if not isinstance(error, MwdnError):  # a defect of this package must not end the live picture for good
                    LOG.exception("live picture")
                    said = f"An error of mwdn itself: {type(error).__name__}. The server's log says more."
                self._publish({"error": said}, b"", b"")
            # The next viewer starts no recording; one that runs goes on, in another file, when the camera is back.
            self._is_recording &= bool(self._wake) and isinstance(failure, CameraError)
            self._changed.clear()
            if failure and self._wake and not self._is_stopped:
                self._changed.wait(self._retry_s)
            with self._lock:  # somebody may have come since the last one left
                if self._is_stopped or not self._wake:
                    self._thread = None
                    return

    def _frames(self, recording: ExitStack) -> Iterator[CameraFrame]:
        """All frames; settings change between them, and each is recorded if that is wanted."""
        recorder: Recorder | None = None
        self._recorded, self._unrecorded = None, ""
        while self._wake and not self._is_stopped:
            self._configure()
            frame = self._read()
            if frame is None:
                continue
            if self._is_recording and recorder is None:
                self._recording = time.strftime("recording-%Y%m%d-%H%M%S.h5", time.gmtime())
                recorder = recording.enter_context(record(self.folder / self._recording, camera=self.camera.name))
            if not self._is_recording and recorder is not None:
                recorder, self._recorded, self._unrecorded = None, None, ""
                recording.close()
            if recorder is not None:
                self._append(recorder, frame)
            yield frame
        recording.close()

    def _append(self, recorder: Recorder, frame: CameraFrame) -> None:
        """Record a frame; one of another format is only shown."""
        self._unrecorded = ""
        try:
            recorder.append(frame)
        except CameraError as error:
            self._unrecorded = str(error)
        self._recorded = len(recorder)

    def _read(self) -> CameraFrame | None:
        """The next frame; ``None`` if it is damaged, or if nobody has taken one."""
        try:
            return self.camera.read()
        except ImageError as error:
            self._publish({"error": str(error)}, b"", b"")
        except SilentCameraError:
            if not self.camera.waits:
                raise
            if self._picture is None:
                self._publish({"error": f"{self.camera.name} has no new frame yet."}, b"", b"")
        return None

    def _configure(self) -> None:
        """Set what viewers want of the camera; a value that it refuses must not end the picture."""
        while self._pending:
            name, value = self._pending.popitem()
            try:
                self.camera.configure(**{name: value})
            except MwdnError as error:
                self._refused = str(error)

    def _results(self, recording: ExitStack) -> Generator["_Result", None, None]:
        """The newest picture each time.

        On a CPU two frames are in progress, each on half of the processors: 18 frames/s on two processors, against 12
        with one frame on both (docs/performance.md). On a GPU one frame is in progress.
        """
        workers = min(2, usable_processors()) if self._device.type == "cpu" else 1
        threads = max(1, usable_processors() // workers)
        return latest_results(self._begin, self._frames(recording), workers=workers, threads=threads)

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
            self._picture, frame = picture, picture.frame
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
            self._publish(said | {"dropped": dropped} | self._about(picture), *encoded)

    def _about(self, picture: LivePicture) -> dict[str, Any]:
        """For JSON: the frame, and the settings of its picture, which all viewers share."""
        frame, settings = picture.frame, picture.settings
        reasons = (self._refused, self._unrecorded, self.pictures.refused, picture.wrong)
        return {
            "number": frame.number,
            "exposure_s": finite(frame.exposure_s),
            "gain": finite(frame.gain),
            "refused": " ".join(filter(None, reasons)),
            "recorded": self._recorded,
            "recording": self._recording,
            "method": settings.method,
            "options": settings.options,
            "align": settings.align,
            "room_light": settings.room_light,
            "ambient": picture.has_ambient,
        }

    def _count(self, stage: str, seconds: float) -> None:
        self.metrics.add("mwdn_live_seconds_total", seconds, stage=stage)

    def _publish(self, said: dict[str, Any], measurement: bytes, scene: bytes) -> None:
        said |= {"measurement_bytes": len(measurement), "scene_bytes": len(scene)}
        head = json.dumps(said).encode()
        self._newest = len(head).to_bytes(4, "little") + head + measurement + scene
        with self._lock:
            wake = list(self._wake.values())
        for call in wake:
            call()
