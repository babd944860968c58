"""Interface of a camera: opened, configured, read frame by frame, closed."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from mwdn.calibration import FrameFormat
from mwdn.errors import CameraError, reason
from mwdn.io.raw import Mosaic

TIMEOUT_S = 5.0
"""Seconds to wait for a frame, besides its exposure."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraFrame:
    """A raw frame and its metadata.

    Args:
        array: (H, W, 1) or (H, W, 3), RGB, uint8 or uint16: the numbers of the sensor, unpacked, in the lower bits.
        bit_depth: bits of the sensor; saturation is ``2^bit_depth - 1``.
        mosaic: colours of a 2 x 2 cell, row by row; ``None`` for a grey sensor, or where the camera delivers RGB.
        exposure_s: exposure in seconds; NaN if the camera does not say.
        gain: in the camera's own unit: decibels by GenICam, a factor on a Raspberry Pi, a step of V4L2's drivers; NaN
            if the camera does not say.
        timestamp: end of the exposure as far as it is known, by this computer's clock: seconds since 1970.
        number: of the frame since the camera was opened; numbers of lost frames are skipped.
        dropped: frames lost between the one before and this one.
    """

    array: npt.NDArray[Any]
    bit_depth: int
    mosaic: Mosaic | None = None
    exposure_s: float = float("nan")
    gain: float = float("nan")
    timestamp: float = 0.0
    number: int = 0
    dropped: int = 0

    @property
    def format(self) -> FrameFormat:
        """How this frame becomes a measurement, as far as the camera knows: bit depth and mosaic."""
        return FrameFormat(bit_depth=self.bit_depth, mosaic=self.mosaic)

    @property
    def kind(self) -> tuple[tuple[int, ...], str, int, Mosaic | None]:
        """What frames of one session have in common: shape, type, bit depth and mosaic."""
        return self.array.shape, self.array.dtype.name, self.bit_depth, self.mosaic


class SilentCameraError(CameraError):
    """No frame has come in time."""


class CameraSource(ABC):
    """A camera. Use it in a ``with`` statement, which opens and closes it.

    The constructor only takes options. After `close`, or a `CameraError`, `open` connects again.

    Args:
        name: as in the messages, and as it is opened on the command line: ``v4l2:0``.
        timeout_s: seconds to wait for a frame, besides its exposure.
    """

    live = True
    """Whether timestamps are of now: not those of a recording."""

    may_pause = False
    """Whether it is no failure if no frame comes for long, and `read` goes on after a damaged one."""

    def __init__(self, name: str, timeout_s: float = TIMEOUT_S) -> None:
        self.name, self.timeout_s = name, timeout_s

    @abstractmethod
    def open(self) -> None:
        """Connect to the camera and start it.

        Raises:
            MissingPackageError: its driver is not installed.
            CameraError: the camera is missing, or used by another program.
        """

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set the exposure in seconds and the gain in the camera's unit (`CameraFrame`); ``None`` changes nothing.

        Frames that are in progress may still have the old values: each `CameraFrame` says its own.

        Raises:
            CameraError: the camera is not open, refuses a value, or has no such setting.
        """
        for name, value in (("exposure_s", exposure_s), ("gain", gain)):
            if value is not None:
                raise CameraError(f"{self.name} has no setting `{name}` ({value:g}). Leave it out.")

    @abstractmethod
    def read(self) -> CameraFrame:
        """Wait for the next frame. If the camera is faster than its reader, the oldest frames are dropped.

        Raises:
            CameraError: the camera is not open, was disconnected, or delivers no frame in time.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the camera and let others use it. Closing twice is allowed."""

    def __enter__(self) -> "CameraSource":
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[CameraFrame]:
        """All frames, without end; `mwdn.runtime.latest` yields the newest of them each time."""
        while True:
            yield self.read()

    def not_open(self) -> CameraError:
        """The error of a camera that is read before it is opened."""
        return CameraError(f"{self.name} is not open. Read inside `with {type(self).__name__}(...) as camera:`.")

    def silent(self) -> SilentCameraError:
        """The error of a camera that delivers no frame in time."""
        return SilentCameraError(
            f"{self.name} has delivered no frame for {self.timeout_s:g} s. Check its cable, power and trigger, or wait "
            "longer: `timeout_s`."
        )

    @contextmanager
    def as_camera_error(self, what: str, advice: str, *, close: bool = True) -> Iterator[None]:
        """Turn any error of a driver's library into a `CameraError`: ``{name} {what}: {reason}. {advice}``.

        Args:
            what: has gone wrong: ``cannot be opened``.
            advice: the way out, a sentence.
            close: whether to close the camera after the error. A `CameraError` from within always closes it.
        """
        try:
            yield
        except CameraError:
            self.close()
            raise
        except Exception as error:  # each library has kinds of its own
            if close:
                self.close()
            raise CameraError(f"{self.name} {what}: {reason(error)}. {advice}") from error


def check_like(frame: CameraFrame, first: CameraFrame, name: str) -> None:
    """Check that a frame has the size, type, bit depth and mosaic of an earlier one.

    Raises:
        CameraError: it differs.
    """
    if frame.kind != first.kind:
        now, before = ("{} {}, {} bits, mosaic {}".format(*kind) for kind in (frame.kind, first.kind))
        raise CameraError(
            f"{name} delivers other frames ({now}) than before ({before}). Set the camera as it was; nothing is lost."
        )
