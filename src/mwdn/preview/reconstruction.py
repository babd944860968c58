"""One reconstruction for a client: from an uploaded capture to a picture and a report."""

import hashlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from mwdn.calibration import Calibration
from mwdn.diagnosis.captures import examine_capture, refuse_dark
from mwdn.diagnosis.psf_encoding import PsfGammaTest
from mwdn.diagnosis.sizes import mismatch
from mwdn.diagnosis.trust import check_size, examine_picture
from mwdn.diagnosis.verdict import Verdict
from mwdn.errors import ImageError, ShapeError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.formats import is_for_viewing
from mwdn.preview.cameras import check_pixels, read_upload
from mwdn.preview.jobs import Job
from mwdn.preview.limits import Limits
from mwdn.preview.result import Result
from mwdn.runtime.iterations import watch_iterations
from mwdn.runtime.transfers import to_device
from mwdn.solvers.alignment import align
from mwdn.solvers.pose import Pose
from mwdn.types import Frame, Measurement, Scene

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
        psf_for_viewing: the PSF's file is of a type for viewing, such as JPEG.
    """

    capture: bytes
    calibration: Callable[[], Calibration]
    method: str = "universal-small"
    options: dict[str, Any] = field(default_factory=dict)
    align: bool | None = None
    trust: bool = True
    room_light: bool | None = None
    ambient: bytes = b""
    psf_for_viewing: bool = False


class Reconstructions:
    """Runs orders, and keeps prepared methods for the next one.

    Args:
        limits: of the server.
        device: see `Reconstructor`.
    """

    def __init__(self, limits: Limits, device: str | None = None) -> None:
        self.limits, self.device = limits, device
        self._lock = threading.Lock()
        self._prepared: OrderedDict[tuple[Any, ...], tuple[Calibration, Reconstructor, PsfGammaTest]] = OrderedDict()

    def prepare(self, order: Order, calibration: Calibration) -> tuple[Reconstructor, PsfGammaTest]:
        """The method for the camera, and the test of the PSF's gamma, which needs a capture.

        Raises:
            MwdnError: no such method or option, or it does not fit the camera.
        """
        check_size(calibration.psf)
        ambient = hashlib.sha256(order.ambient).digest()
        options = tuple(sorted(order.options.items()))
        key = (id(calibration), order.method, options, order.align, order.room_light, ambient)
        with self._lock:
            if key in self._prepared:
                self._prepared.move_to_end(key)
                return self._prepared[key][1:]
        lit = with_ambient(calibration, order.ambient, self.limits)
        how: dict[str, Any] = {"align": order.align, "room_light": order.room_light, "device": self.device}
        made = Reconstructor(order.method, lit, **how, **order.options)
        with self._lock:
            # The calibration is kept, so that its id stays its own.
            self._prepared[key] = calibration, made, PsfGammaTest(lit, order.psf_for_viewing)
            while len(self._prepared) > KEPT:
                self._prepared.popitem(last=False)
            return self._prepared[key][1:]

    def run(self, job: Job, order: Order) -> None:
        """Reconstruct; the picture is in the job before it is checked.

        Raises:
            MwdnError: what is wrong with the capture, the camera or the method.
        """
        start = time.perf_counter()
        reconstruct, gamma = self.prepare(order, order.calibration())
        calibration = reconstruct.calibration
        frame, for_viewing = read_capture(order.capture, calibration, self.limits)
        measurement = to_device(to_measurement(frame, calibration, self.limits), reconstruct.device)
        job.advance(0.0)
        with watch_iterations(lambda _: job.advance(0.0)):  # which may cancel
            measurement, share = reconstruct.without_room_light(measurement)
            pose = align(measurement, reconstruct.psf) if reconstruct.align else None
        with watch_iterations(lambda part: job.advance(0.9 * part)):
            scene = reconstruct.without_search(pose).on_device(measurement)
        if not scene.isfinite().all():
            raise ImageError("The reconstruction holds NaN or infinity. Scale the capture, or use another method.")
        report = _report(order, reconstruct, time.perf_counter() - start)
        report["room_light"] = None if share is None else round(float(share), 4)
        shown = reconstruct.as_recorded(scene).cpu()
        job.result = Result(measurement.cpu(), shown, calibration.light, calibration.white_balance, report)
        if order.trust:
            job.advance(0.9)
            job.state = "checking"
            with torch.inference_mode():
                verdicts = examine_capture(frame, calibration, for_viewing=for_viewing)
                verdicts += gamma(frame, verdicts)
                found = _check(verdicts, measurement, reconstruct, scene, pose)
            job.result = replace(job.result, report=report | found)


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


def read_capture(data: bytes, calibration: Calibration, limits: Limits) -> tuple[Frame, bool]:
    """A raw frame, and whether its file is of a type for viewing.

    Raises:
        MwdnError: the file is wrong.
    """

    def read(path: Any) -> tuple[Frame, bool]:  # noqa: ANN401
        return calibration.frames.read(path), is_for_viewing(path)

    return read_upload(data, "capture", limits.frame_pixels, read)


def to_measurement(frame: Frame, calibration: Calibration, limits: Limits) -> Measurement:
    """A measurement that fits the camera.

    Raises:
        MwdnError: it does not fit; it has too many pixels; it is dark.
    """
    measurement = calibration.to_measurement(frame)
    check_pixels("capture", (measurement.shape[-2], measurement.shape[-1]), limits)
    try:
        calibration.check_fit(measurement)
    except ShapeError as error:
        raise mismatch(error, measurement, calibration) from None
    refuse_dark(measurement)
    return measurement


def _check(
    verdicts: tuple[Verdict, ...],
    measurement: Measurement,
    reconstruct: Reconstructor,
    scene: Scene,
    pose: Pose | None,
) -> dict[str, Any]:
    """The verdicts, with those on the PSF's orientation and the picture, and the numbers behind them."""
    given = reconstruct.calibration.psf_format.psf_orientation
    trust = examine_picture(measurement, reconstruct.psf, scene, pose=pose, given=given)
    if not trust.finite:
        raise ImageError("The numbers of the capture are too large or too small to be judged. Scale it.")
    listed = [{**asdict(verdict), "sentence": verdict.sentence} for verdict in (*verdicts, *trust.verdicts)]
    return {**trust.content, "summary": trust.sentence, "verdicts": listed}
