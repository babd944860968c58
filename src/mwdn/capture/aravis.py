"""GenICam cameras (GigE Vision, USB3 Vision) by Aravis, a free library: no vendor's software is needed."""

import sys
import time
from contextlib import suppress
from functools import cache
from importlib import util
from importlib.machinery import PathFinder
from typing import Any

from mwdn.capture.pixel_formats import PixelFormat, choose_format, unpack
from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource
from mwdn.capture.sources import load_driver
from mwdn.errors import CameraError

BUFFERS = 5
"""Frames that Aravis can hold: more do not help, since only the newest is used."""

SYSTEM_PACKAGES = "/usr/lib/python3/dist-packages"
"""Where Debian's python3-gi is: PyGObject from PyPI needs a compiler and headers."""


class AravisCamera(CameraSource):
    """A GenICam camera.

    Args:
        address: serial number, IP address or name as `arv-tool-0.8` lists them; ``first`` for any, ``fake`` for
            Aravis's own simulation inside this process.
        pixel_format: GenICam's name, ``Mono12``; by default the unpacked raw format with the most bits.
        timeout_s: seconds to wait for a frame, besides its exposure.
    """

    def __init__(self, address: str, *, pixel_format: str = "", timeout_s: float = TIMEOUT_S) -> None:
        super().__init__(f"aravis:{address}", timeout_s)
        self.address, self.pixel_format = address, pixel_format
        self._camera: Any = None
        self._stream: Any = None
        self._lost = False

    def open(self) -> None:
        """Connect, choose the format, and start."""
        library = _library()
        self.close()
        if self.address == "fake":
            library.enable_interface("Fake")
        name = {"first": None, "fake": "Fake_1"}.get(self.address, self.address)
        with self.as_camera_error("cannot be opened", "Check its cable and address: `arv-tool-0.8`."):
            self._camera = library.Camera.new(name)
            self._camera.get_device().connect("control-lost", self._on_lost)
            self._start()
        self._lost = False

    def _start(self) -> None:
        camera, library = self._camera, _library()
        name, self._format = choose_format(
            camera.dup_available_pixel_formats_as_strings(), self.pixel_format, self.name
        )
        camera.set_pixel_format_from_string(name)
        with suppress(Exception):  # a fixed exposure: an automatic one would change between pictures
            camera.set_exposure_time_auto(library.Auto.OFF)
            camera.set_gain_auto(library.Auto.OFF)
        camera.set_acquisition_mode(library.AcquisitionMode.CONTINUOUS)
        self._stream = camera.create_stream(None, None)
        for _ in range(BUFFERS):
            self._stream.push_buffer(library.Buffer.new_allocate(camera.get_payload()))
        camera.start_acquisition()
        self._last = -1
        self._settings()

    def _settings(self) -> None:
        """Read exposure and gain back: a camera rounds them."""
        self._exposure_s, self._gain = float("nan"), float("nan")
        with suppress(Exception):
            self._exposure_s = self._camera.get_exposure_time() / 1e6
        with suppress(Exception):
            self._gain = self._camera.get_gain()

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set exposure in seconds and gain in decibels.

        Raises:
            CameraError: not open, or the camera refuses a value.
        """
        if self._camera is None:
            raise self.not_open()
        for label, value, bounds, set_value in (
            ("exposure_s", exposure_s, self._camera.get_exposure_time_bounds, self._camera.set_exposure_time),
            ("gain", gain, self._camera.get_gain_bounds, self._camera.set_gain),
        ):
            if value is None:
                continue
            scale = 1e6 if label == "exposure_s" else 1.0
            with self.as_camera_error(f"has no setting `{label}`", "Leave it out.", close=False):
                low, high = (bound / scale for bound in bounds())
            if not low <= value <= high:
                raise CameraError(f"{self.name} takes `{label}` ({value:g}) from {low:g} to {high:g}.")
            with self.as_camera_error(f"refuses `{label}` ({value:g})", "Choose another value.", close=False):
                set_value(value * scale)
        self._settings()

    def read(self) -> CameraFrame:
        """The newest frame that has not been read, or the next one."""
        if self._stream is None:
            raise self.not_open()
        library, wait_s = _library(), self.timeout_s + (self._exposure_s if self._exposure_s > 0 else 0)
        deadline, failed = time.monotonic() + wait_s, 0
        while (left := deadline - time.monotonic()) > 0:
            if self._lost:
                break
            buffer = self._stream.timeout_pop_buffer(int(min(left, 0.5) * 1e6))
            if buffer is None:
                continue
            while (newer := self._stream.try_pop_buffer()) is not None:
                self._stream.push_buffer(buffer)
                buffer = newer
            try:
                if buffer.get_status() == library.BufferStatus.SUCCESS:
                    return self._frame(buffer)
                failed += 1  # network packets were lost
            finally:
                self._stream.push_buffer(buffer)
        if self._lost:
            raise CameraError(f"{self.name} was disconnected. Check its cable and power.")
        if failed:
            raise CameraError(
                f"{self.name} delivered {failed} incomplete frames in {wait_s:g} s. Switch its network to jumbo "
                "frames, or choose a smaller picture."
            )
        raise self.silent()

    def _frame(self, buffer: Any) -> CameraFrame:  # noqa: ANN401
        format: PixelFormat = self._format
        size = buffer.get_image_height(), buffer.get_image_width()
        number = int(buffer.get_frame_id())
        dropped = max(number - self._last - 1, 0) if self._last >= 0 else 0
        self._last = number
        return CameraFrame(
            array=unpack(buffer.get_data(), format, size),
            bit_depth=format.bit_depth,
            mosaic=format.mosaic,
            exposure_s=self._exposure_s,
            gain=self._gain,
            timestamp=buffer.get_system_timestamp() / 1e9,
            number=number,
            dropped=dropped,
        )

    def close(self) -> None:
        """Stop and release the camera."""
        if self._camera is not None:
            with suppress(Exception):  # it may be disconnected
                self._camera.stop_acquisition()
        self._stream = self._camera = None

    def _on_lost(self, *_: object) -> None:
        self._lost = True


@cache
def _library() -> Any:  # noqa: ANN401
    """Aravis's bindings.

    Raises:
        MissingPackageError: not installed.
    """
    _find_gi()
    gi = load_driver("aravis", "gi")
    with suppress(ValueError):  # not installed: the import says so
        gi.require_version("Aravis", "0.8")
    return load_driver("aravis", "gi.repository.Aravis")


def _find_gi() -> None:
    """Load the system's PyGObject where a virtual environment has none."""
    if "gi" in sys.modules or util.find_spec("gi") is not None:
        return
    spec = PathFinder.find_spec("gi", [SYSTEM_PACKAGES])
    if spec is None or spec.loader is None:
        return
    module = sys.modules["gi"] = util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules["gi"]
        raise
