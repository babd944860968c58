"""Pictures, frames and text in and out of files."""

from mwdn.io.files import atomic
from mwdn.io.images import read_frame, read_picture, srgb_decode, srgb_encode, write_linear, write_picture

__all__ = [
    "atomic",
    "read_frame",
    "read_picture",
    "srgb_decode",
    "srgb_encode",
    "write_linear",
    "write_picture",
]
