"""Sizes of pictures from their headers, and whether their files are complete: checked before they are decoded."""

import re
import struct
import zlib

from mwdn.errors import ImageError
from mwdn.types import Size

COPY_AGAIN = "Copy it from its source again."
_JPEG_MARKER = re.compile(rb"\xff[\x02-\xcf\xd8-\xfe]")  # FF 00 and FF D0 to D7 belong to the compressed data


def picture_size(kind: str, data: bytes) -> Size:
    """Height and width that a file claims.

    Args:
        kind: PNG, JPEG, WebP or BMP.
        data: content of the file.

    Raises:
        ImageError: cut off or damaged; the message does not name the file.
    """
    return {"PNG": _png_size, "JPEG": _jpeg_size, "WebP": _webp_size, "BMP": _bmp_size}[kind](data)


def _png_size(data: bytes) -> Size:
    view, position, kind = memoryview(data), 8, b""
    while kind != b"IEND":
        end, kind = position + 12 + int.from_bytes(view[position:][:4]), bytes(view[position + 4 :][:4])
        if end > len(data):
            raise ImageError(f"is cut off: after {len(data):,} bytes this PNG has no end (IEND). {COPY_AGAIN}")
        # An upper-case first letter marks critical chunks.
        if kind[:1].isupper() and zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(view[end - 4 : end]):
            raise ImageError(f"is damaged: the checksum of {kind!r} at byte {position:,} is wrong. {COPY_AGAIN}")
        position = end
    return int.from_bytes(data[20:24]), int.from_bytes(data[16:20])


def _jpeg_size(data: bytes) -> Size:
    position, size = 2, b""
    while marker := _JPEG_MARKER.search(data, position):
        code, position = marker.group()[1], marker.end()
        if code == 0xD9:
            return int.from_bytes(size[:2]), int.from_bytes(size[2:])
        if 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC):  # the start of a frame, not a table
            size = data[position + 3 : position + 7]
        position += int.from_bytes(data[position : position + 2])  # skips a thumbnail, which has its own end marker
    raise ImageError(f"is cut off: after {len(data):,} bytes this JPEG has no end (FF D9). {COPY_AGAIN}")


def _bmp_size(data: bytes) -> Size:
    head = data[:34].ljust(34, b"\0")
    start, header = struct.unpack_from("<II", head, 10)
    width, height, _, bits = struct.unpack_from("<4H" if header == 12 else "<iiHH", head, 18)
    packed = header > 12 and head[30] not in (0, 3)  # run-length encoded: only the decoder knows the size
    needed = start + (0 if packed else (width * bits + 31) // 32 * 4 * abs(height))  # rows are padded to 4 bytes
    if len(data) < max(needed, 26):
        raise ImageError(f"is cut off: this BMP has {len(data):,} bytes and needs {needed:,}. {COPY_AGAIN}")
    return abs(height), width  # a negative height puts the top row first


def _webp_size(data: bytes) -> Size:
    needed = 8 + int.from_bytes(data[4:8], "little")
    if len(data) < max(needed, 30):
        raise ImageError(f"is cut off: this WebP has {len(data):,} bytes and needs {needed:,}. {COPY_AGAIN}")
    match data[12:16]:
        case b"VP8X":  # with alpha, EXIF or animation: 24 bits each, less one
            return int.from_bytes(data[27:30], "little") + 1, int.from_bytes(data[24:27], "little") + 1
        case b"VP8L":  # lossless: 14 bits each, less one
            bits = int.from_bytes(data[21:25], "little")
            return (bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1
        case _:  # lossy: 14 bits each, and 2 of a scale
            width, height = struct.unpack_from("<HH", data, 26)
            return height & 0x3FFF, width & 0x3FFF
