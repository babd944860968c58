"""A plugin's camera: its errors name the plugin, and its frames are checked."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from mwdn.capture.source import CameraFrame, CameraSource
from mwdn.errors import CameraError, MwdnError, PluginError, shown
from mwdn.runtime.plugins import plugin_errors


class PluginCamera(CameraSource):
    """Passes every call on to `camera`, which a plugin has made.

    Args:
        kind: name of the plugin.
        create: its class or function.
        *address: of the camera, if this kind has one.
        **options: of the camera.

    Raises:
        CameraError: the plugin failed, or has made something else.
    """

    def __init__(
        self,
        kind: str,
        create: Callable[..., CameraSource],
        /,
        *address: str,
        **options: Any,  # noqa: ANN401
    ) -> None:
        self._kind, self._create = kind, create
        with self._errors():
            self.camera = create(*address, **options)
        if not isinstance(self.camera, CameraSource):
            raise CameraError(f"The plugin `{kind}` must make a `CameraSource`, not {shown(self.camera)}.")
        super().__init__(self.camera.name, self.camera.timeout_s)
        self.live, self.may_pause = self.camera.live, self.camera.may_pause

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            with plugin_errors(self._kind, self._create):
                yield
        except PluginError as error:  # a session opens a camera again after a `CameraError`
            raise CameraError(str(error)) from error

    def open(self) -> None:
        """Connect to the camera and start it."""
        self.camera.timeout_s = self.timeout_s
        with self._errors():
            self.camera.open()

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set exposure and gain."""
        with self._errors():
            self.camera.configure(exposure_s, gain)

    def read(self) -> CameraFrame:
        """The next frame.

        Raises:
            CameraError: also if it is not as `CameraFrame` says.
        """
        with self._errors():
            frame = self.camera.read()
        if not isinstance(frame, CameraFrame):
            raise CameraError(f"The plugin `{self._kind}` must deliver a `CameraFrame`, not {shown(frame)}.")
        shape: tuple[int, ...] = getattr(frame.array, "shape", ())
        kind = str(getattr(frame.array, "dtype", ""))
        if len(shape) != 3 or shape[2] not in (1, 3) or 0 in shape or kind not in ("uint8", "uint16"):
            raise CameraError(
                f"The plugin `{self._kind}` must deliver arrays (H, W, 1 or 3) of uint8 or uint16, not "
                f"{shown(frame.array)}."
            )
        return frame

    def close(self) -> None:
        """Stop the camera; a warning says if it fails, because everything that was read is kept."""
        try:
            with self._errors():
                self.camera.close()
        except MwdnError as error:
            warnings.warn(f"{self.name} was not closed. {error}", stacklevel=2)
