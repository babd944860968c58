"""Basler's cameras by pypylon, which brings the vendor's driver with it."""

import math
import time
from contextlib import suppress
from typing import Any

from mwdn.capture.pixel_formats import choose_format, unpack
from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource
from mwdn.capture.sources import load_driver
from mwdn.errors import CameraError

_EXPOSURES = "ExposureTime", "ExposureTimeAbs"
_GAINS = ("Gain",)


class PylonCamera(CameraSource):
    """A camera of Basler. With the variable PYLON_CAMEMU=1, Basler's emulated camera is there, too.

    Args:
        address: serial number, or a part of the camera's name; ``first`` for any.
        pixel_format: GenICam's name, ``Mono12``; by default the unpacked raw format with the most bits.
        timeout_s: seconds to wait for a frame, besides its exposure.
    """

    def __init__(self, address: str, *, pixel_format: str = "", timeout_s: float = TIMEOUT_S) -> None:
        super().__init__(f"pypylon:{address}", timeout_s)
        self.address, self.pixel_format = address, pixel_format
        self._camera: Any = None
        self._pylon: Any = None

    def open(self) -> None:
        """Connect, choose the format, and start."""
        pylon = load_driver("pypylon", "pypylon.pylon")
        self.close()
        self._pylon = pylon
        factory = pylon.TlFactory.GetInstance()
        devices = list(factory.EnumerateDevices())
        names = [f"{each.GetFriendlyName()} {each.GetSerialNumber()}" for each in devices]
        matches = [
            number for number, name in enumerate(names) if self.address in ("first", name) or self.address in name
        ]
        if not matches or (len(matches) > 1 and self.address != "first"):
            raise CameraError(
                f"{self.name} names {len(matches)} of {len(devices)} cameras: "
                f"{', '.join(names)[:150] or 'none found'}. Check its cable; give its serial number."
            )
        with self.as_camera_error("cannot be opened", "Close other programs that use it."):
            self._camera = pylon.InstantCamera(factory.CreateDevice(devices[matches[0]]))
            self._camera.Open()
            self._start()

    def _start(self) -> None:
        camera = self._camera
        name, self._format = choose_format(camera.PixelFormat.Symbolics, self.pixel_format, self.name)
        camera.PixelFormat.Value = name
        for automatic in ("ExposureAuto", "GainAuto"):
            with suppress(Exception):  # not every camera has it
                getattr(camera, automatic).Value = "Off"
        camera.StartGrabbing(self._pylon.GrabStrategy_LatestImageOnly)
        self._number = -1

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set exposure in seconds and gain in decibels.

        Raises:
            CameraError: not open, or the camera refuses a value or has no such setting.
        """
        if self._camera is None:
            raise self.not_open()
        for label, nodes, value, scale in (("exposure_s", _EXPOSURES, exposure_s, 1e6), ("gain", _GAINS, gain, 1.0)):
            if value is None:
                continue
            node = self._node(nodes)
            if node is None:
                raise CameraError(f"{self.name} has no setting `{label}`. Leave it out.")
            try:
                node.Value = value * scale
            except Exception as error:  # of pypylon, of several kinds
                raise CameraError(
                    f"{self.name} takes `{label}` ({value:g}) from {node.Min / scale:g} to {node.Max / scale:g}."
                ) from error

    def _node(self, names: tuple[str, ...]) -> Any:  # noqa: ANN401
        """The first setting of these names that the camera has."""
        for name in names:
            with suppress(Exception):
                node = getattr(self._camera, name)
                _ = node.Value
                return node
        return None

    def _setting(self, names: tuple[str, ...]) -> float:
        node = self._node(names)
        return math.nan if node is None else float(node.Value)

    def read(self) -> CameraFrame:
        """The newest frame that has not been read, or the next one."""
        if self._camera is None:
            raise self.not_open()
        exposure_s, gain = self._setting(_EXPOSURES) / 1e6, self._setting(_GAINS)
        wait_s = self.timeout_s + (exposure_s if exposure_s > 0 else 0)
        with self.as_camera_error("was disconnected", "Check its cable and power."):
            result = self._camera.RetrieveResult(int(1e3 * wait_s), self._pylon.TimeoutHandling_Return)
        if not result.IsValid():
            raise self.silent()
        try:
            if not result.GrabSucceeded():
                raise CameraError(f"{self.name} lost a frame: {result.ErrorDescription}. Read again.")
            array = unpack(result.Buffer, self._format, (result.Height, result.Width))
            dropped = int(result.NumberOfSkippedImages)
        finally:
            result.Release()
        self._number += 1 + dropped
        return CameraFrame(
            array=array,
            bit_depth=self._format.bit_depth,
            mosaic=self._format.mosaic,
            exposure_s=exposure_s,
            gain=gain,
            timestamp=time.time(),
            number=self._number,
            dropped=dropped,
        )

    def close(self) -> None:
        """Stop and release the camera."""
        with suppress(Exception):  # it may be disconnected
            self._camera.Close()
        self._camera = None
