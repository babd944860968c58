"""A reconstruction as a client can have it: a picture for viewing, the exact numbers, and a report."""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy.typing as npt
from torch import Tensor

from mwdn.calibration.white_balance import WhiteBalance, apply_white_balance, check_white_balance
from mwdn.errors import ParameterError
from mwdn.io.contact_sheets import to_display
from mwdn.io.images import write_linear, write_picture
from mwdn.types import Measurement, Scene

PictureFormat = Literal["png", "png16", "tiff", "npy"]
MEDIA = {
    "png": ("image/png", ".png"),
    "png16": ("image/png", ".png"),
    "tiff": ("image/tiff", ".tif"),
    "npy": ("application/octet-stream", ".npy"),
}
"""Media type and suffix of each format. png and png16 are sRGB, tiff and npy the linear float32 numbers."""

STOPS = 6.0
"""Largest change of the exposure of a picture for viewing."""


@dataclass(frozen=True)
class Look:
    """How a picture is shown.

    Args:
        format: see `MEDIA`.
        exposure: in stops, of pictures for viewing: 1 is twice as bright.
        white_balance: see `mwdn.calibration.white_balance`; "camera" for that of the calibration.

    Raises:
        ParameterError: a value is outside its range.
    """

    format: PictureFormat = "png"
    exposure: float = 0.0
    white_balance: WhiteBalance | Literal["camera"] | None = "camera"

    def __post_init__(self) -> None:
        if not -STOPS <= self.exposure <= STOPS:
            raise ParameterError(f"`exposure` ({self.exposure}) must be from -{STOPS:g} to {STOPS:g} stops.")
        if isinstance(self.white_balance, tuple):
            check_white_balance(self.white_balance, (1.0,) * 3)  # gains; for the camera see `balance`

    @property
    def white_balance_text(self) -> str:
        """The white balance as a request names it."""
        if isinstance(self.white_balance, tuple):
            return ",".join(map(str, self.white_balance))
        return self.white_balance or "none"

    def balance(self, scene: Scene, light: tuple[float, ...], own: WhiteBalance | None) -> Scene:
        """Apply the white balance to a scene, of a camera with this light of the point source and this own balance.

        Raises:
            ParameterError: the white balance is not possible for this camera.
        """
        chosen = own if self.white_balance == "camera" else self.white_balance
        if chosen is None:
            return scene
        check_white_balance(chosen, light)
        return apply_white_balance(scene, chosen, light)


@dataclass(frozen=True)
class Result:
    """A finished reconstruction.

    Args:
        measurement: (1, C, H, W).
        scene: (1, C, H, W), in the colours of the camera.
        light: of the point source, for the white balance.
        white_balance: of the calibration.
        report: for JSON.
        frame: the raw frame of a live picture, as the camera delivered it.
    """

    measurement: Measurement
    scene: Scene
    light: tuple[float, ...] = ()
    white_balance: WhiteBalance | None = None
    report: dict[str, Any] = field(default_factory=dict)
    frame: npt.NDArray[Any] | None = None

    @property
    def size(self) -> int:
        """Memory of the pictures."""
        return self.measurement.nbytes + self.scene.nbytes + (0 if self.frame is None else self.frame.nbytes)

    def encode(self, look: Look) -> bytes:
        """The scene as a file.

        Raises:
            ParameterError: the white balance is not possible for this camera.
        """
        return encode(look.balance(self.scene, self.light, self.white_balance), look)


def encode(image: Tensor, look: Look) -> bytes:
    """An image (1, C, H, W) in linear light as a file; the white balance is not applied."""
    with tempfile.TemporaryDirectory(prefix="mwdn-") as folder:
        path = Path(folder) / f"picture{MEDIA[look.format][1]}"
        if look.format in ("tiff", "npy"):
            write_linear(path, image)
        else:
            shown = (to_display(image) * 2**look.exposure).clamp(0, 1)
            write_picture(path, shown, bits=16 if look.format == "png16" else 8)
        return path.read_bytes()
