"""Read and write pictures, frames and text.

Each name is imported at its first use: pictures need torch, text does not.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mwdn.io.formats import as_frame
    from mwdn.io.images import (
        read_frame,
        read_picture,
        srgb_decode,
        srgb_encode,
        write_frame,
        write_imagej,
        write_linear,
        write_picture,
    )

__all__ = [
    "as_frame",
    "read_frame",
    "read_picture",
    "srgb_decode",
    "srgb_encode",
    "write_frame",
    "write_imagej",
    "write_linear",
    "write_picture",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name at its first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module 'mwdn.io' has no attribute '{name}'")
    module = import_module("mwdn.io.formats" if name == "as_frame" else "mwdn.io.images")
    value = globals()[name] = getattr(module, name)
    return value
