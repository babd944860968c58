"""Raspberry Pi cameras by picamera2, raw.

This module avoids two errors. The Pi's usual raw formats are packed (``SRGGB10_CSI2P``) or compressed (``PISP_COMP1``):
read as numbers they are noise, so they are refused. And the order of the colours depends on how the sensor is turned or
flipped, so it is that of the configured stream, not of the sensor's data sheet.
"""

import time
from contextlib import suppress
from typing import Any

from mwdn.capture.pixel_formats import libcamera_format, unpack
from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource
from mwdn.capture.sources import load_driver
from mwdn.errors import CameraError, reason


class PiCamera(CameraSource):
    """A Raspberry Pi camera.

    Args:
        number: of the camera, in the order of ``rpicam-hello --list-cameras``.
        pixel_format: libcamera's name of an unpacked raw format, ``SRGGB12``; by default the sensor mode with the most
            pixels and bits.
        timeout_s: seconds to wait for a frame, besides its exposure.
    """

    def __init__(self, *, number: int = 0, pixel_format: str = "", timeout_s: float = TIMEOUT_S) -> None:
        super().__init__("picamera2", timeout_s)
        self.number, self.pixel_format = number, pixel_format
        self._camera: Any = None

    def open(self) -> None:
        """Connect, choose an unpacked raw format, and start."""
        library = load_driver("picamera2", "picamera2")
        self.close()
        advice = "Close other programs that use it; see `rpicam-hello --list-cameras`."
        with self.as_camera_error("cannot be opened", advice):
            self._camera = library.Picamera2(self.number)
            self._start()

    def _start(self) -> None:
        wanted = self.pixel_format or self._best()
        if libcamera_format(wanted) is None:
            raise CameraError(f"{self.name}: `pixel_format` ({wanted}) must be unpacked, such as SRGGB12 or R10.")
        modes = [mode for mode in self._camera.sensor_modes if str(mode.get("unpacked")) == wanted]
        raw = {"format": wanted, **({"size": max(mode["size"] for mode in modes)} if modes else {})}
        self._camera.configure(self._camera.create_video_configuration(raw=raw, buffer_count=3))
        stream = self._camera.camera_configuration()["raw"]
        name, (width, height) = str(stream["format"]), stream["size"]
        format = libcamera_format(name)
        if format is None:
            raise CameraError(
                f"{self.name} delivers '{name}', which is packed or compressed, instead of '{wanted}'. Choose another "
                "`pixel_format`."
            )
        self._format, self._size, self._stride = format, (int(height), int(width)), int(stream["stride"])
        self._camera.set_controls({"AeEnable": False, "AwbEnable": False})
        self._camera.start()
        self._number = -1

    def _best(self) -> str:
        """The unpacked format of the sensor mode with the most pixels, then bits."""
        modes = [mode for mode in self._camera.sensor_modes if libcamera_format(str(mode.get("unpacked")))]
        if not modes:
            raise CameraError(f"{self.name} offers no unpacked raw format.")
        best = max(modes, key=lambda mode: (mode["size"][0] * mode["size"][1], mode["bit_depth"]))
        return str(best["unpacked"])

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set exposure in seconds and gain, a factor; a few frames still have the old values, as their metadata say.

        Raises:
            CameraError: not open, or a value outside of the camera's range.
        """
        if self._camera is None:
            raise self.not_open()
        controls: dict[str, Any] = {}
        for label, name, value in (
            ("exposure_s", "ExposureTime", None if exposure_s is None else round(exposure_s * 1e6)),
            ("gain", "AnalogueGain", gain),
        ):
            if value is None:
                continue
            low, high, *_ = self._camera.camera_controls[name]
            if not low <= value <= high:
                given = exposure_s if label == "exposure_s" else gain
                scale = 1e6 if label == "exposure_s" else 1
                raise CameraError(f"{self.name} takes `{label}` ({given:g}) from {low / scale:g} to {high / scale:g}.")
            controls[name] = value
        self._camera.set_controls(controls)

    def read(self) -> CameraFrame:
        """The next frame."""
        if self._camera is None:
            raise self.not_open()
        try:
            request = self._camera.capture_request(wait=self.timeout_s)
        except TimeoutError as error:
            raise self.silent() from error
        except Exception as error:  # of libcamera, of several kinds
            raise CameraError(f"{self.name} was disconnected: {reason(error)}. Check its cable.") from error
        try:
            metadata = request.get_metadata()
            array = unpack(request.make_buffer("raw"), self._format, self._size, self._stride)
        finally:
            request.release()
        self._number += 1
        return CameraFrame(
            array=array,
            bit_depth=self._format.bit_depth,
            mosaic=self._format.mosaic,
            exposure_s=metadata["ExposureTime"] / 1e6,
            gain=float(metadata["AnalogueGain"]),
            timestamp=time.time(),
            number=self._number,
        )

    def close(self) -> None:
        """Stop and release the camera."""
        with suppress(Exception):  # it may be disconnected
            self._camera.close()
        self._camera = None
