"""GenICam cameras by a vendor's GenTL producer (a .cti file) and harvesters: HIKROBOT, Daheng, IDS, Baumer, ..."""

import math
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from mwdn.capture.pixel_formats import choose_format, unpack
from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource
from mwdn.capture.sources import load_driver
from mwdn.errors import CameraError
from mwdn.runtime.interrupts import kept_interrupt

PRODUCERS = "GENICAM_GENTL64_PATH"
"""Variable in which installers of producers put their folders (GenTL standard 1.5, section 3.1)."""


class HarvestersCamera(CameraSource):
    """A camera of a GenTL producer.

    Args:
        address: of the camera: its number (``0``), serial number, or a part of its name.
        cti: the producer's file; by default each one in the folders of `PRODUCERS`.
        pixel_format: GenICam's name, ``Mono12``; by default the unpacked raw format with the most bits.
        timeout_s: seconds to wait for a frame, besides its exposure.
    """

    def __init__(
        self, address: str, *, cti: str | None = None, pixel_format: str = "", timeout_s: float = TIMEOUT_S
    ) -> None:
        super().__init__(f"harvesters:{address}", timeout_s)
        self.address, self.cti, self.pixel_format = address, cti, pixel_format
        self._harvester: Any = None
        self._acquirer: Any = None

    def open(self) -> None:
        """Load the producers, connect, choose the format, and start."""
        core = load_driver("harvesters", "harvesters.core")
        self.close()
        self._harvester = core.Harvester()
        with self.as_camera_error("cannot be opened", "Close other programs that use it; check its cable."):
            for file in self._producers():
                self._harvester.add_file(str(file), check_existence=True, check_validity=True)
            self._harvester.update()
            with kept_interrupt():  # harvesters' own handler closes the camera and does not interrupt
                self._acquirer = self._harvester.create(self._index())
            self._start()

    def _producers(self) -> list[Path]:
        if self.cti is not None:
            if not Path(self.cti).is_file():
                raise CameraError(f"`cti` (`{self.cti}`) does not exist. Give the .cti file of the vendor's driver.")
            return [Path(self.cti)]
        folders = filter(None, os.environ.get(PRODUCERS, "").split(os.pathsep))
        files = [file for folder in folders for file in sorted(Path(folder).glob("*.cti"))]
        if not files:
            raise CameraError(f"{self.name} needs the vendor's driver: set {PRODUCERS}, or give its file: `cti=x.cti`.")
        return files

    def _index(self) -> int:
        devices = list(self._harvester.device_info_list)
        names = [f"{each.display_name} {each.id_} {each.serial_number}" for each in devices]
        if self.address.isdecimal() and int(self.address) < len(devices):
            return int(self.address)
        matches = [number for number, name in enumerate(names) if self.address in name]
        if len(matches) != 1:
            raise CameraError(
                f"{self.name} names {len(matches)} of {len(devices)} cameras: "
                f"{', '.join(names)[:150] or 'none found'}. Give its number."
            )
        return matches[0]

    def _start(self) -> None:
        nodes = self._acquirer.remote_device.node_map
        name, self._format = choose_format(nodes.PixelFormat.symbolics, self.pixel_format, self.name)
        nodes.PixelFormat.value = name
        for automatic in ("ExposureAuto", "GainAuto"):
            with suppress(Exception):  # not every camera has it
                getattr(nodes, automatic).value = "Off"
        self._acquirer.num_buffers = 3
        self._acquirer.start()
        self._number = -1

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set exposure in seconds and gain in decibels.

        Raises:
            CameraError: not open, or the camera refuses a value or has no such setting.
        """
        if self._acquirer is None:
            raise self.not_open()
        nodes = self._acquirer.remote_device.node_map
        for label, node, value, unit in (("exposure_s", "ExposureTime", exposure_s, 1e6), ("gain", "Gain", gain, 1.0)):
            if value is not None:
                with self.as_camera_error(f"refuses `{label}` ({value:g})", "Choose another value.", close=False):
                    getattr(nodes, node).value = value * unit

    def _setting(self, node: str) -> float:
        """A setting of the camera; NaN if it has none."""
        with suppress(Exception):
            return float(getattr(self._acquirer.remote_device.node_map, node).value)
        return math.nan

    def read(self) -> CameraFrame:
        """The newest frame that has not been read, or the next one."""
        if self._acquirer is None:
            raise self.not_open()
        exposure_s, gain = self._setting("ExposureTime") / 1e6, self._setting("Gain")
        wait_s = self.timeout_s + (exposure_s if exposure_s > 0 else 0)
        newest = self._fetch(wait_s)
        if newest is None:
            raise self.silent()
        dropped = 0
        while (newer := self._fetch(0.0)) is not None:
            newest.queue()
            newest, dropped = newer, dropped + 1
        self._number += 1 + dropped
        try:
            part = newest.payload.components[0]
            array = unpack(part.data, self._format, (int(part.height), int(part.width)))
        finally:
            newest.queue()
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

    def _fetch(self, wait_s: float) -> Any:  # noqa: ANN401
        """A filled buffer, or ``None`` after this time."""
        with self.as_camera_error("was disconnected", "Check its cable and power.", close=False):
            return self._acquirer.try_fetch(timeout=max(wait_s, 1e-3))

    def close(self) -> None:
        """Stop, and release the camera and its producers."""
        for part, end in ((self._acquirer, "stop"), (self._acquirer, "destroy"), (self._harvester, "reset")):
            with suppress(Exception):  # the camera may be disconnected
                getattr(part, end)()
        self._acquirer = self._harvester = None
