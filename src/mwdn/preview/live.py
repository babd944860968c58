"""The live picture: one camera and one reconstruction for all viewers; the newest frame wins, nothing queues."""

import asyncio
import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mwdn.calibration import Calibration
from mwdn.capture.recording import Recorder, record
from mwdn.capture.source import CameraSource, Frame
from mwdn.errors import MwdnError, ParameterError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import to_display
from mwdn.io.images import srgb_encode
from mwdn.preview.metrics import Metrics
from mwdn.runtime.streams import latest

QUALITY = 90
"""Of the JPEGs that viewers get."""

RATE_FRAMES = 20
"""Frames over which the rate is averaged."""

SETTINGS = ("exposure_s", "gain")


class Live:
    """A camera that runs while somebody looks.

    Args:
        camera: opened for the first viewer, closed after the last.
        calibration: of the camera.
        method: see `Reconstructor`.
        folder: of recordings.
        device: see `Reconstructor`.
    """

    def __init__(
        self,
        camera: CameraSource,
        calibration: Calibration,
        *,
        method: str = "universal-small",
        folder: Path,
        device: str | None = None,
    ) -> None:
        self.camera, self.calibration, self.method, self.device = camera, calibration, method, device
        self.folder, self.metrics = folder, Metrics()
        self._lock = threading.Lock()
        self._wake: dict[int, Callable[[], None]] = {}
        self._thread: threading.Thread | None = None
        self._pending: dict[str, float] = {}
        self._is_recording = self._is_stopped = False
        self._recorded, self._refused = 0, ""
        self._newest: bytes | None = None

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
                self._is_stopped, self._newest = False, None
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()
            return number

    def leave(self, number: int) -> None:
        """Remove a viewer; the camera stops after the last."""
        with self._lock:
            self._wake.pop(number, None)

    @property
    def viewers(self) -> int:
        """Number of viewers."""
        return len(self._wake)

    @property
    def newest(self) -> bytes | None:
        """The newest message for viewers."""
        return self._newest

    def control(self, message: dict[str, Any]) -> None:
        """What a viewer asks for: ``exposure_s``, ``gain``, ``record``.

        Raises:
            ParameterError: something else, or of another type.
        """
        for name, value in message.items():
            if name in SETTINGS and isinstance(value, int | float) and not isinstance(value, bool):
                self._pending[name] = float(value)
            elif name == "record" and isinstance(value, bool):
                self._is_recording = value
            else:
                raise ParameterError(f"`{name[:40]}` must be exposure_s, gain (numbers) or record (true, false).")

    def close(self) -> None:
        """Stop the camera; a recording is complete afterwards."""
        self._is_stopped = True
        thread = self._thread
        if thread is not None:
            thread.join(timeout=20)

    def _run(self) -> None:
        is_failed = False
        while True:
            try:
                with self.camera, ExitStack() as recording, closing(latest(self._frames(recording))) as frames:
                    self._reconstruct(frames)
            except MwdnError as error:
                is_failed = True
                self._publish({"error": str(error)}, b"", b"")
            with self._lock:  # somebody may have come since the last one left
                if is_failed or self._is_stopped or not self._wake:
                    self._thread = None
                    return

    def _frames(self, recording: ExitStack) -> Iterator[Frame]:
        """All frames; settings change between them, and each is recorded if that is wanted."""
        recorder: Recorder | None = None
        while self._wake and not self._is_stopped:
            while self._pending:
                name, value = self._pending.popitem()
                self._refused = ""
                try:
                    self.camera.configure(**{name: value})
                except MwdnError as error:  # a value that the camera refuses must not end the picture
                    self._refused = str(error)
            frame = self.camera.read()
            if self._is_recording and recorder is None:
                name = time.strftime("recording-%Y%m%d-%H%M%S.h5", time.gmtime())
                recorder = recording.enter_context(record(self.folder / name, camera=self.camera.name))
                self._recorded = 0
            if not self._is_recording and recorder is not None:
                recorder = None
                recording.close()
            if recorder is not None:
                recorder.append(frame)
                self._recorded += 1
            yield frame
        recording.close()

    def _reconstruct(self, frames: Iterator[Frame]) -> None:
        reconstruct: Reconstructor | None = None
        times: deque[float] = deque(maxlen=RATE_FRAMES)
        before: Frame | None = None
        dropped = 0
        for frame in frames:
            if reconstruct is None:
                reconstruct = Reconstructor(self.method, self._calibration(frame), align=False, device=self.device)
            start = time.time()
            measurement = reconstruct.calibration.correct(frame.array)
            with torch.inference_mode():
                scene = reconstruct(measurement)
            lost = frame.dropped if before is None else max(frame.number - before.number - 1, 0)
            dropped, before = dropped + lost, frame
            self.metrics.add("mwdn_live_frames_total")
            self.metrics.add("mwdn_live_dropped_total", lost)
            pictures = _jpeg(measurement.clamp(min=0)), _jpeg(scene)
            now = time.time()
            times.append(now)
            rate = (len(times) - 1) / (times[-1] - times[0]) if times[-1] > times[0] else 0.0
            said = {
                "fps": round(rate, 1),
                "latency_ms": round(1000 * (now - (frame.timestamp or start))),
                "dropped": dropped,
                "number": frame.number,
                "exposure_s": _finite(frame.exposure_s),
                "gain": _finite(frame.gain),
                "refused": self._refused,
                "recorded": self._recorded if self._is_recording else None,
            }
            self._publish(said, *pictures)

    def _calibration(self, frame: Frame) -> Calibration:
        """The calibration, with what the camera says about its frames."""
        frames = self.calibration.frames
        depth, mosaic = frames.bit_depth or frame.bit_depth, frames.mosaic or frame.mosaic
        return replace(self.calibration, frames=replace(frames, bit_depth=depth, mosaic=mosaic))

    def _publish(self, said: dict[str, Any], measurement: bytes, scene: bytes) -> None:
        said |= {"measurement_bytes": len(measurement), "scene_bytes": len(scene)}
        head = json.dumps(said).encode()
        self._newest = len(head).to_bytes(4, "little") + head + measurement + scene
        with self._lock:
            wake = list(self._wake.values())
        for call in wake:
            call()


async def serve_viewer(live: Live, socket: Any) -> None:  # noqa: ANN401
    """One viewer's WebSocket: a slow one skips frames, and does not delay the others."""
    from starlette.websockets import WebSocketDisconnect

    await socket.accept()
    loop, fresh = asyncio.get_running_loop(), asyncio.Event()

    def wake() -> None:
        with suppress(RuntimeError):  # the server has stopped
            loop.call_soon_threadsafe(fresh.set)

    number = live.join(wake)

    async def send() -> None:
        while True:
            await fresh.wait()
            fresh.clear()
            if live.newest is not None:
                await socket.send_bytes(live.newest)

    sender = asyncio.create_task(send())
    try:
        while True:
            message = json.loads(await socket.receive_text())
            if not isinstance(message, dict):
                raise ParameterError("A message must be a JSON object.")
            live.control(message)
    except (WebSocketDisconnect, RuntimeError):
        pass
    except (MwdnError, ValueError, KeyError, RecursionError):  # not from our page
        await socket.close(1003)
    finally:
        live.leave(number)
        sender.cancel()


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _jpeg(image: Tensor) -> bytes:
    import cv2

    pixels = srgb_encode(to_display(image))[0].mul(255).round().byte().movedim(0, -1).numpy()
    bgr = np.ascontiguousarray(pixels[..., ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
