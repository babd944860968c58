"""Read and write pictures, frames and text.

Each name is imported at its first use: pictures need torch, text does not.
"""

from typing import TYPE_CHECKING

from mwdn.first_use import at_first_use

if TYPE_CHECKING:
    from mwdn.io.arrays import as_frame
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

__getattr__ = at_first_use(__name__, dict.fromkeys(__all__, "images") | {"as_frame": "arrays"})
