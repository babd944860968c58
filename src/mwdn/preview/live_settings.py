"""What viewers of the live picture may change, and the messages that change it."""

from dataclasses import dataclass, field, fields, replace
from types import NoneType
from typing import Any

from mwdn.calibration import Calibration
from mwdn.calibration.white_balance import check_white_balance
from mwdn.errors import ParameterError
from mwdn.inference.methods import as_method
from mwdn.inference.reconstructor import Reconstructor
from mwdn.preview.methods import checked_options
from mwdn.preview.result import Look
from mwdn.preview.uploads import parse_white_balance
from mwdn.solvers import Admm, Fista, WarmStart

CAMERA_SETTINGS = ("exposure_s", "gain")
"""Settings of the camera itself."""

SETTING_TYPES: dict[str, tuple[type, ...]] = {
    "exposure_s": (int, float),
    "gain": (int, float),
    "record": (bool,),
    "ambient": (bool,),
    "method": (str,),
    "options": (dict,),
    "align": (bool, NoneType),
    "room_light": (bool, NoneType),
    "stops": (int, float),
    "white_balance": (str,),
}
"""What a message may hold, and the types of JSON; ``ambient`` takes the next frame as that of the room's light."""

FOLLOWING = 10
"""Iterations of ADMM and FISTA for each frame but the first."""


@dataclass(frozen=True)
class LiveSettings:
    """How frames become pictures.

    Args:
        method: see `mwdn.preview.methods`.
        options: of the method.
        align: fit the pose of the PSF to the first frame; ``None`` does as the method does by default.
        room_light: find the room's light in each frame, see `mwdn.Reconstructor`; ``None`` likewise.
        look: exposure and white balance of the pictures.
    """

    method: str = "universal-small"
    options: dict[str, Any] = field(default_factory=dict)
    align: bool | None = None
    room_light: bool | None = None
    look: Look = field(default_factory=Look)

    def changed(self, message: dict[str, Any], light: tuple[float, ...]) -> "LiveSettings":
        """The settings after a message; options of another method are forgotten.

        Args:
            message: checked by `check_message`.
            light: of the point source.

        Raises:
            MwdnError: no such method or option, or a value is outside its range.
        """
        own = {part.name: message[part.name] for part in fields(self) if part.name in message}
        if "method" in own and own["method"] != self.method:
            own.setdefault("options", {})
        changed = replace(self, **own)
        options = checked_options(changed.method, changed.options)
        look = replace(self.look, exposure=float(message.get("stops", self.look.exposure)))
        if "white_balance" in message:
            look = replace(look, white_balance=parse_white_balance(message["white_balance"]))
        if look.white_balance != "camera":
            check_white_balance(look.white_balance, light)
        return replace(changed, options=options, look=look)

    def prepare(self, calibration: Calibration, device: str | None) -> Reconstructor:
        """The method for a camera. ADMM and FISTA go on from the frame before.

        Raises:
            MwdnError: an option is outside its range, or the method does not fit the camera.
        """
        method: Any = as_method(self.method, **self.options)
        if isinstance(method, Admm | Fista):
            method = WarmStart(method, iterations=min(method.iterations, FOLLOWING))
        return Reconstructor(method, calibration, align=self.align, device=device, room_light=self.room_light)

    def is_same_method(self, other: "LiveSettings") -> bool:
        """Whether only the look differs."""
        return replace(self, look=other.look) == other


def check_message(message: Any) -> dict[str, Any]:  # noqa: ANN401
    """A message of a viewer.

    Raises:
        ParameterError: not an object, or a name or type that the page never sends.
    """
    if not isinstance(message, dict):
        raise ParameterError("A message must be a JSON object.")
    for name, value in message.items():
        if type(value) not in SETTING_TYPES.get(name, ()):
            raise ParameterError(f"`{name[:40]}` must be one of {', '.join(SETTING_TYPES)}, of the right type.")
    return message
