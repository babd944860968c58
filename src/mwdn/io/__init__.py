"""Read and write pictures, frames and text."""

from mwdn.io.formats import as_frame
from mwdn.io.images import read_frame, read_picture, srgb_decode, srgb_encode, write_frame, write_linear, write_picture

__all__ = [
    "as_frame",
    "read_frame",
    "read_picture",
    "srgb_decode",
    "srgb_encode",
    "write_frame",
    "write_linear",
    "write_picture",
]
