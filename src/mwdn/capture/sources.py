"""Kinds of cameras by name, and the string that opens a camera: ``aravis:Basler-2134,pixel_format=Mono12``."""

import re
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

from mwdn.arguments import check_options
from mwdn.capture.plugin_camera import PluginCamera
from mwdn.capture.source import CameraSource
from mwdn.errors import CameraError, UnknownNameError
from mwdn.io.toml import parse_value
from mwdn.runtime.plugins import Registry
from mwdn.runtime.requirement import require


class Kind(NamedTuple):
    """A kind of camera.

    Args:
        place: module in `mwdn.capture`, and class; a plugin's class or function itself.
        address: meaning of what follows the colon; empty if nothing does.
        requires: how to install what it needs; empty for what the package has.
    """

    place: str | Callable[..., CameraSource]
    address: str = ""
    requires: str = ""


def _extra(name: str) -> str:
    return f"pip install 'mwdn[{name}]'"


_OWN = {
    "aravis": Kind(
        "aravis:AravisCamera",
        "its name, serial number or IP address, or `first` or `fake`",
        "apt install gir1.2-aravis-0.8 python3-gi (and pip install 'mwdn[aravis]' for another Python than Debian's)",
    ),
    "folder": Kind("folder:WatchedFolder", "a folder that another program writes frames to"),
    "harvesters": Kind("harvesters:HarvestersCamera", "its number, serial number or name", _extra("harvesters")),
    "picamera2": Kind("picamera:PiCamera", "", "apt install python3-picamera2, or pip install 'mwdn[picamera2]'"),
    "pypylon": Kind("pylon:PylonCamera", "its serial number or name, or `first`", _extra("pypylon")),
    "replay": Kind("recording:Replay", "an .h5 file of recorded frames or captured pairs"),
    "rig": Kind("rig:open_rig", ""),
    "v4l2": Kind("v4l2:V4l2Camera", "its number (`v4l2:0`) or device"),
}

SOURCES: Registry[Kind] = Registry(
    _OWN,
    "mwdn.cameras",
    accepts=lambda entry: isinstance(entry, Kind) and callable(entry.place),
    must_be="a `mwdn.capture.Kind` of a class or function that returns a `mwdn.capture.CameraSource`",
)
"""Kinds of cameras by name, those of plugins included. A new one in this package needs one line above and one file."""


def open_source(text: str, **options: Any) -> CameraSource:  # noqa: ANN401
    """A camera from one string; use it in a ``with`` statement.

    Args:
        text: ``NAME``, ``NAME:ADDRESS`` or ``NAME:ADDRESS,option=value,...``: one of `SOURCES`, which camera of this
            kind, and keyword arguments of its class.
        **options: further keyword arguments.

    Raises:
        UnknownNameError: no such kind of camera, or option.
        ParameterError: an option has another type or is outside its range.
        CameraError: the address is missing, or a plugin fails.
    """
    name, address, given = parse_source(text)
    if name not in SOURCES:
        raise UnknownNameError("camera", name, SOURCES)
    kind = SOURCES[name]
    if bool(address) != bool(kind.address):
        needs = f"needs {kind.address}: `{name}:...`" if kind.address else f"has no address ('{address}'): `{name}`"
        raise CameraError(f"The camera `{text}` {needs}.")
    create = kind.place
    if isinstance(create, str):
        module, _, cls = create.partition(":")
        create = getattr(import_module(f"mwdn.capture.{module}"), cls)
    options = {**given, **options}
    check_options(create, f"the camera '{name}'", options)
    if name not in SOURCES.own:
        create = partial(PluginCamera, name, create)
    return create(address, **options) if kind.address else create(**options)


def parse_source(text: str) -> tuple[str, str, dict[str, Any]]:
    """Name, address and options of a camera's string. An address may hold commas and colons."""
    parts = text.split(",")
    given: dict[str, Any] = {}
    while len(parts) > 1 and re.fullmatch(r"[a-z_]+=.*", parts[-1], re.DOTALL):
        key, _, value = parts.pop().partition("=")
        given.setdefault(key, parse_value(value))
    name, _, address = ",".join(parts).partition(":")
    return name, address, given


def load_driver(name: str, module: str) -> Any:  # noqa: ANN401
    """Import a camera's library, without its warnings: as errors they end SWIG's modules with a segmentation fault.

    Args:
        name: of the kind of camera.
        module: to import.

    Raises:
        MissingPackageError: it is not installed.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return require(module, name, purpose=f"The camera `{name}`", install=SOURCES[name].requires)
