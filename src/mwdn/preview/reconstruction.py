"""One reconstruction for a client: from an uploaded capture to a picture and a report."""

import hashlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from mwdn.calibration import Calibration
from mwdn.diagnosis.trust import Trust, check_size
from mwdn.diagnosis.verdict import Verdict
from mwdn.inference.capture_pipeline import CapturePipeline, PsfFile, refuse_infinite
from mwdn.inference.reconstructor import Reconstructor
from mwdn.preview.cameras import check_pixels, read_upload
from mwdn.preview.jobs import Job
from mwdn.preview.limits import Limits
from mwdn.preview.result import Result
from mwdn.runtime.iterations import watch_iterations
from mwdn.types import size_of

KEPT = 4
"""Prepared methods that are kept for the next capture; one of 1 Mpixel takes about 100 MB."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """What a client wants.

    Args:
        capture: the file of a raw frame.
        calibration: reads that of its camera.
        method: see `mwdn.preview.methods`.
        options: of the method.
        align: as for `Reconstructor`.
        trust: check the picture, which takes a second or two.
        room_light: as for `Reconstructor`.
        ambient: the file of a frame of the room's light alone, taken as the capture; empty if there is none.
        psf_file: returns what the PSF's file tells besides its pixels.
    """

    capture: bytes
    calibration: Callable[[], Calibration]
    method: str = "universal-small"
    options: dict[str, Any] = field(default_factory=dict)
    align: bool | None = None
    trust: bool = True
    room_light: bool | None = None
    ambient: bytes = b""
    psf_file: Callable[[], PsfFile] = PsfFile


class Reconstructions:
    """Runs orders, and keeps prepared methods for the next one.

    Args:
        limits: of the server.
        device: see `Reconstructor`.
    """

    def __init__(self, limits: Limits, device: str | None = None) -> None:
        self.limits, self.device = limits, device
        self._lock = threading.Lock()
        self._prepared: OrderedDict[tuple[Any, ...], tuple[Calibration, CapturePipeline]] = OrderedDict()

    def prepare(self, order: Order, calibration: Calibration) -> CapturePipeline:
        """The pipeline of a method and a camera, from the cache if it is there.

        Raises:
            MwdnError: no such method or option, or it does not fit the camera.
        """
        check_size(calibration.psf)
        ambient = hashlib.sha256(order.ambient).digest()
        options = tuple(sorted(order.options.items()))
        psf_file = order.psf_file()
        key = (id(calibration), psf_file, order.method, options, order.align, order.room_light, ambient)
        with self._lock:
            if key in self._prepared:
                self._prepared.move_to_end(key)
                return self._prepared[key][1]
        lit = with_ambient(calibration, order.ambient, self.limits)
        how: dict[str, Any] = {"align": order.align, "room_light": order.room_light, "device": self.device}
        made = Reconstructor(order.method, lit, **how, **order.options)
        with self._lock:
            # The calibration is kept, so that its id stays its own.
            self._prepared[key] = calibration, CapturePipeline(made, psf_file)
            while len(self._prepared) > KEPT:
                self._prepared.popitem(last=False)
            return self._prepared[key][1]

    def run(self, job: Job, order: Order) -> None:
        """Reconstruct; the picture is in the job before it is checked.

        Raises:
            MwdnError: what is wrong with the capture, the camera or the method.
        """
        start = time.perf_counter()
        pipeline = self.prepare(order, order.calibration())
        reconstruct, calibration = pipeline.reconstruct, pipeline.calibration
        frame = read_upload(order.capture, "capture", self.limits.frame_pixels, calibration.frames.read)
        measurement = calibration.to_measurement(frame)
        check_pixels("capture", size_of(measurement), self.limits)
        pipeline.check(measurement)
        job.advance(0.0)
        with watch_iterations(lambda _: job.advance(0.0)):  # which may cancel
            prepared = pipeline.prepare(measurement, pose=reconstruct.align)
        with watch_iterations(lambda part: job.advance(0.9 * part)):
            scene = pipeline.solve(prepared)
        refuse_infinite(prepared, scene)
        report = _report(order, reconstruct, time.perf_counter() - start)
        report["room_light"] = None if prepared.room_light is None else round(prepared.room_light, 4)
        shown = reconstruct.as_recorded(scene).cpu()
        job.result = Result(prepared.measurement.cpu(), shown, calibration.light, calibration.white_balance, report)
        if order.trust:
            job.advance(0.9)
            job.state = "checking"
            verdicts = pipeline.examine_frame(frame, order.capture)
            trust, verdicts = pipeline.examine_scene(prepared, scene, verdicts)
            job.result = replace(job.result, report=report | _verdict_report(trust, verdicts))


def with_ambient(calibration: Calibration, ambient: bytes, limits: Limits) -> Calibration:
    """The calibration with an uploaded frame of the room's light, if there is one.

    Raises:
        MwdnError: the file is wrong.
    """
    if not ambient:
        return calibration
    frame = read_upload(ambient, "ambient", limits.frame_pixels, calibration.frames.read)
    return replace(calibration, ambient=calibration.frames.offset(frame, "ambient"))


def _report(order: Order, reconstruct: Reconstructor, seconds: float) -> dict[str, Any]:
    height, width = reconstruct.calibration.size
    return {
        "method": order.method,
        "options": order.options,
        "aligned": reconstruct.align,
        "psf_hash": reconstruct.calibration.psf_hash,
        "bin": reconstruct.calibration.frames.bin,
        "height": height,
        "width": width,
        "seconds": round(seconds, 3),
        "warning": reconstruct.warning,
    }


def _verdict_report(trust: Trust, verdicts: tuple[Verdict, ...]) -> dict[str, Any]:
    """The verdicts, and the numbers behind them."""
    listed = [{**asdict(verdict), "sentence": verdict.sentence} for verdict in verdicts]
    return {**trust.content, "summary": trust.sentence, "verdicts": listed}
