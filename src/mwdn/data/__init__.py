"""Pictures and frames in and out of files, in linear light."""

from mwdn.data.images import read_frame, read_picture, srgb_decode, srgb_encode, write_linear, write_picture
from mwdn.data.writing import atomic

__all__ = [
    "atomic",
    "read_frame",
    "read_picture",
    "srgb_decode",
    "srgb_encode",
    "write_linear",
    "write_picture",
]
