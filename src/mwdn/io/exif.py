"""EXIF orientation: how a picture is to be turned when it is shown. The pixels stay as the sensor stored them."""

import struct
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mwdn.errors import ImageError
from mwdn.io.reading import open_regular
from mwdn.types import Frame

TURNS = {
    2: "flip-left-right",
    3: "rotate-180",
    4: "flip-top-bottom",
    5: "transpose",
    6: "rotate-270",
    7: "transverse",
    8: "rotate-90",
}
"""Transposition that makes a picture of each orientation upright, as in ``PIL.Image.Transpose``: rotations are
anticlockwise."""

_ORIENTATION = 274
"""Number of the tag."""

_STEPS = 100_000
"""Largest number of parts of a file that are searched: a PNG of 800 MB has as many."""


def orientation(file: str | Path | bytes) -> int:
    """EXIF orientation of a JPEG, PNG, WebP, TIFF, or raw file that is a TIFF inside; reads a few hundred bytes.

    Args:
        file: the file, or its content.

    Returns:
        1 to 8, see `TURNS`; 1 (upright) if the file has no such tag, or cannot be read.
    """
    if isinstance(file, bytes):
        return orientation_in(BytesIO(file))
    try:
        with open_regular(file) as opened:
            return orientation_in(opened)
    except (OSError, ImageError):  # reading the pixels reports the error
        return 1


def orientation_in(file: BinaryIO | BytesIO) -> int:
    """As `orientation`, of an open file."""
    try:
        start = _find_tiff(file)
        turn = 1 if start is None else _read_tag(file, start)
    except (ImageError, struct.error):  # cut off
        return 1
    return turn if turn in TURNS else 1


def upright(frame: Frame, orientation: int) -> Frame:
    """A picture (H, W, C) of this orientation, turned as `TURNS` says."""
    frame = frame.swapaxes(0, 1) if 5 <= orientation <= 8 else frame
    return frame[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def _find_tiff(file: BinaryIO | BytesIO) -> int | None:
    """Position of the EXIF block, which is a small TIFF."""
    head = file.read(12)
    if head[:2] in (b"II", b"MM"):
        return 0
    if head.startswith(b"\xff\xd8"):
        return _in_jpeg(file)
    if head.startswith(b"\x89PNG"):
        return _in_png(file)
    if head[:4] == b"RIFF" and head[8:] == b"WEBP":
        return _in_webp(file)
    return None


def _in_jpeg(file: BinaryIO | BytesIO) -> int | None:
    position = 2
    for _ in range(_STEPS):
        marker, length = struct.unpack(">HH", _at(file, position, 4))
        if marker == 0xFFE1 and file.read(6) == b"Exif\0\0":
            return position + 10
        if marker < 0xFFC0 or marker == 0xFFDA:  # the compressed data begins
            return None
        position += 2 + length
    return None


def _in_png(file: BinaryIO | BytesIO) -> int | None:
    position = 8
    for _ in range(_STEPS):
        length, name = struct.unpack(">I4s", _at(file, position, 8))
        if name == b"eXIf":
            return position + 8
        position += 12 + length  # a checksum follows the data
    return None


def _in_webp(file: BinaryIO | BytesIO) -> int | None:
    position = 12
    for _ in range(_STEPS):
        name, length = struct.unpack("<4sI", _at(file, position, 8))
        if name == b"EXIF":
            return position + (14 if file.read(6) == b"Exif\0\0" else 8)  # some programs write JPEG's header
        position += 8 + length + length % 2
    return None


def _at(file: BinaryIO | BytesIO, position: int, count: int) -> bytes:
    file.seek(position)
    return file.read(count)


def _read_tag(file: BinaryIO | BytesIO, start: int) -> int:
    """The orientation in the first directory of a TIFF."""
    order = "<" if _at(file, start, 2) == b"II" else ">"
    version, offset = struct.unpack(order + "HI", file.read(6))
    if version == 43:  # BigTIFF; no camera writes it
        return 1
    (count,) = struct.unpack(order + "H", _at(file, start + offset, 2))
    for _ in range(count):
        tag, _, _, value = struct.unpack(order + "HHIH2x", file.read(12))
        if tag == _ORIENTATION:
            return int(value)
    return 1
