"""Webcams and board cameras by OpenCV and Linux's V4L2."""

import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.capture.pixel_formats import PixelFormat, unpack, v4l2_format
from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource
from mwdn.errors import CameraError, ParameterError

EXPOSURE_UNIT_S = 1e-4
"""Unit of V4L2_CID_EXPOSURE_ABSOLUTE."""

MANUAL = 1
"""V4L2_EXPOSURE_MANUAL."""


class V4l2Camera(CameraSource):
    """A camera of V4L2.

    Args:
        address: number (``0`` is /dev/video0) or path of the device.
        fourcc: a raw, unpacked format by its four characters, ``RG10`` or ``Y16``. By default frames are pictures of
            8 bits as the driver makes them, RGB and coded for viewing: calibrate with ``gamma = "srgb"``.
        width: in pixels; the driver's unless given.
        height: likewise.
        timeout_s: seconds to wait for a frame, besides its exposure.

    Raises:
        ParameterError: the format is packed or unknown.
    """

    def __init__(
        self,
        address: str,
        *,
        fourcc: str = "",
        width: int | None = None,
        height: int | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        super().__init__(f"v4l2:{address}", timeout_s)
        self.device = f"/dev/video{address}" if address.isdecimal() else address
        self.fourcc, self.size = fourcc, (height, width)
        self._format = v4l2_format(fourcc) if fourcc else None
        if fourcc and self._format is None:
            raise ParameterError(
                f"`fourcc` ('{fourcc}') must be an unpacked raw format, such as RG10, BA12, Y16 or GREY. See "
                "`v4l2-ctl --list-formats`."
            )
        self._capture: Any = None

    def open(self) -> None:
        """Connect, set size and format, and start."""
        import cv2

        self.close()
        self._check_device()
        backend = cv2.CAP_V4L2 if self.device.startswith("/dev/") else cv2.CAP_ANY  # a video file serves in tests
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(math.ceil(self.timeout_s)))
        self._capture = cv2.VideoCapture(self.device, backend)
        if not self._capture.isOpened():
            self.close()
            raise CameraError(f"{self.name} cannot be opened. Close other programs that use it: `fuser {self.device}`.")
        if self.fourcc:
            self._set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*self.fourcc.ljust(4)), "fourcc")
            self._set(cv2.CAP_PROP_CONVERT_RGB, 0, "fourcc")
        for prop, value, name in (
            (cv2.CAP_PROP_FRAME_HEIGHT, self.size[0], "height"),
            (cv2.CAP_PROP_FRAME_WIDTH, self.size[1], "width"),
        ):
            if value is not None:
                self._set(prop, value, name)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # only the newest frame; some drivers refuse
        self._number, self._exposure_s, self._gain = -1, math.nan, math.nan

    def _check_device(self) -> None:
        path = Path(self.device)
        if not path.exists():
            there = ", ".join(sorted(map(str, Path("/dev").glob("video*")))) or "none"
            raise CameraError(f"{self.name}: there is no `{self.device}`. Cameras here: {there}.")
        if not os.access(path, os.R_OK):
            raise CameraError(f"{self.name}: no permission for `{self.device}`. Join its group: `usermod -aG video`.")

    def _set(self, prop: int, value: float, name: str) -> None:
        self._capture.set(prop, value)
        got = self._capture.get(prop)
        if got != value:
            self.close()
            raise CameraError(f"{self.name} refuses `{name}`. See what it offers: `v4l2-ctl --list-formats-ext`.")

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set exposure in seconds, in steps of 0.1 ms, and gain in steps of the driver.

        Raises:
            CameraError: not open, or the driver refuses a value.
        """
        import cv2

        if self._capture is None:
            raise self.not_open()
        if exposure_s is not None:
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL)
            steps = max(round(exposure_s / EXPOSURE_UNIT_S), 1)
            if not self._capture.set(cv2.CAP_PROP_EXPOSURE, steps) or self._capture.get(cv2.CAP_PROP_EXPOSURE) != steps:
                raise CameraError(
                    f"{self.name} refuses `exposure_s` ({exposure_s:g}). Its range: `v4l2-ctl --list-ctrls`."
                )
            self._exposure_s = steps * EXPOSURE_UNIT_S
        if gain is not None:
            if not self._capture.set(cv2.CAP_PROP_GAIN, gain) or self._capture.get(cv2.CAP_PROP_GAIN) != gain:
                raise CameraError(f"{self.name} refuses `gain` ({gain:g}). Its range: `v4l2-ctl --list-ctrls`.")
            self._gain = gain

    def read(self) -> CameraFrame:
        """The next frame."""
        if self._capture is None:
            raise self.not_open()
        delivered, data = self._capture.read()
        if not delivered:
            if not Path(self.device).exists():
                raise CameraError(f"{self.name} was disconnected. Check its cable.")
            raise self.silent()
        self._number += 1
        array, format = self._unpacked(data)
        return CameraFrame(
            array=array,
            bit_depth=format.bit_depth,
            mosaic=format.mosaic,
            exposure_s=self._exposure_s,
            gain=self._gain,
            timestamp=time.time(),
            number=self._number,
        )

    def _unpacked(self, data: Any) -> tuple[Any, PixelFormat]:  # noqa: ANN401
        """Frame and format; raw buffers come as rows of bytes or of numbers."""
        import cv2

        if self._format is None:
            return np.ascontiguousarray(data[..., ::-1]), PixelFormat(8, None, 3)
        size = tuple(int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        return unpack(data, self._format, (size[0], size[1])), self._format

    def close(self) -> None:
        """Stop and release the camera."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
