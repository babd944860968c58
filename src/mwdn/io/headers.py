"""Sizes of pictures from their headers, and whether their files are complete: checked before they are decoded."""

import re
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from mwdn.errors import ImageError

COPY_AGAIN = "Copy it from its source again."

MAX_HEADER_BYTES = 2**24
"""Bytes at the start of a file in which its header must be: 16 MiB."""

MAX_DECODED_BYTES = 2**30
"""Most bytes of decoded numbers: 1 GiB, 179 million pixels of RGB in 16 bits."""

_ALWAYS = 2**28
"""Decoded bytes that are never too many for a file: 256 MiB. A mask of 16,384 x 16,384 may be small."""

_RATIO = 200
"""Most decoded bytes for each byte of a larger picture's file; noise alone keeps a capture below 20."""

_WORK = 64
"""Most pixels times scans for each byte of a larger progressive JPEG: each scan passes over all pixels."""

_JPEG_MARKER = re.compile(rb"\xff[\x02-\xcf\xd8-\xfe]")  # FF 00 and FF D0 to D7 belong to the compressed data
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}  # grey, RGB, palette, grey with alpha, which OpenCV expands, and RGBA


class Claim(NamedTuple):
    """Size of a picture as stated in its header.

    Args:
        height: of the picture.
        width: of the picture.
        pixel_bytes: memory that the decoder needs for a pixel.
    """

    height: int
    width: int
    pixel_bytes: int


def picture_claim(kind: str, start: bytes, size: int) -> Claim:
    """What a picture's header claims.

    Args:
        kind: PNG, JPEG, WebP or BMP.
        start: first bytes of the file; `MAX_HEADER_BYTES` are enough.
        size: bytes of the whole file.

    Raises:
        ImageError: cut off or damaged; the message does not name the file.
    """
    if kind == "JPEG":
        return _jpeg_claim(start)
    return {"PNG": _png_claim, "WebP": _webp_claim, "BMP": _bmp_claim}[kind](start, size)


def check_whole(kind: str, data: bytes) -> None:
    """Check the structure of a whole file, as far as that needs no decoding.

    Raises:
        ImageError: cut off or damaged, or its scans would take long; the message does not name the file.
    """
    if kind == "JPEG":
        _check_jpeg(data)
    elif kind == "PNG":
        _check_png(data)


def check_decoded(size: int, stored: int) -> None:
    """Refuse pictures that would fill the memory.

    Args:
        size: bytes of the decoded numbers.
        stored: bytes of the file.

    Raises:
        ImageError: over `MAX_DECODED_BYTES`, or far more than the file can hold of a capture.
    """
    if size > MAX_DECODED_BYTES:
        raise ImageError(f"claims {size:,} bytes of pixels; at most {MAX_DECODED_BYTES:,} are read. Crop or bin it.")
    if size > max(_ALWAYS, _RATIO * stored):
        raise ImageError(
            f"claims {size:,} bytes of pixels in a file of {stored:,}. It is damaged, or made to fill the memory; a "
            "picture in one colour can be cropped or binned."
        )


def _png_claim(start: bytes, size: int) -> Claim:
    head = start[:33]
    if len(head) < 33:
        raise ImageError(f"is cut off: after {size:,} bytes this PNG has no end (IEND). {COPY_AGAIN}")
    width, height, bits, colours = struct.unpack_from(">IIBB", head, 16)
    return Claim(height, width, _PNG_CHANNELS.get(colours, 4) * max(1, bits // 8))


def _check_png(data: bytes) -> None:
    view, position, kind = memoryview(data), 8, b""
    while kind != b"IEND":
        end, kind = position + 12 + int.from_bytes(view[position:][:4]), bytes(view[position + 4 :][:4])
        if end > len(data):
            raise ImageError(f"is cut off: after {len(data):,} bytes this PNG has no end (IEND). {COPY_AGAIN}")
        # An upper-case first letter marks critical chunks.
        if kind[:1].isupper() and zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(view[end - 4 : end]):
            raise ImageError(f"is damaged: the checksum of {kind!r} at byte {position:,} is wrong. {COPY_AGAIN}")
        position = end


def _jpeg_parts(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Code of each marker up to the end marker, the start of its part, and the start of the next part."""
    position, code = 2, 0
    while code != 0xD9:
        marker = _JPEG_MARKER.search(data, position)
        if marker is None:
            raise ImageError(f"is cut off: after {len(data):,} bytes this JPEG has no end (FF D9). {COPY_AGAIN}")
        code, start = marker.group()[1], marker.end()
        # The length skips a thumbnail, which has an end marker of its own.
        position = start + (int.from_bytes(data[start : start + 2]) if code != 0xD9 else 0)
        yield code, start, position


def _is_frame(code: int) -> bool:
    """Whether a marker starts a frame, not a table."""
    return 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC)


def _jpeg_claim(data: bytes) -> Claim:
    for code, start, _ in _jpeg_parts(data):
        if _is_frame(code) and len(data) >= start + 8:
            height, width, channels = struct.unpack_from(">HHB", data, start + 3)
            # Progressive: coefficients of 16 bits are kept until the last scan.
            return Claim(height, width, channels * (1 if code in (0xC0, 0xC1) else 3))
    return Claim(0, 0, 1)


def _check_jpeg(data: bytes) -> None:
    claim, scans, coded, frames = _jpeg_claim(data), 0, 0, 0
    for code, _, end in _jpeg_parts(data):
        frames += _is_frame(code)
        if code == 0xDA:
            scans += 1
            following = _JPEG_MARKER.search(data, end)
            coded += (following.start() if following else len(data)) - end
    blocks = -(-claim.height // 8) * -(-claim.width // 8)
    if frames != 1 or 8 * coded < blocks:  # a Huffman code has a bit at least, and a block one code at least
        found = (
            f"{frames} frames" if frames != 1 else f"{coded:,} bytes of pixels and needs {-(-blocks // 8):,} at least"
        )
        raise ImageError(f"is damaged: this JPEG of {claim.height:,} x {claim.width:,} has {found}. {COPY_AGAIN}")
    if scans * claim.height * claim.width > max(_ALWAYS, _WORK * coded):
        raise ImageError(f"has {scans:,} scans, which would take long to decode. Save it as a baseline JPEG.")


def _bmp_claim(data: bytes, size: int) -> Claim:
    head = data[:34].ljust(34, b"\0")
    start, header = struct.unpack_from("<II", head, 10)
    width, height, _, bits = struct.unpack_from("<4H" if header == 12 else "<iiHH", head, 18)
    if header > 12 and head[30] not in (0, 3):
        raise ImageError("is a BMP with compression, which hides damage. Save it as PNG.")
    needed = start + (width * bits + 31) // 32 * 4 * abs(height)  # rows are padded to 4 bytes
    if size < max(needed, 26):
        raise ImageError(f"is cut off: this BMP has {size:,} bytes and needs {needed:,}. {COPY_AGAIN}")
    return Claim(abs(height), width, 4)  # a negative height puts the top row first


def _webp_claim(data: bytes, size: int) -> Claim:
    needed = 8 + int.from_bytes(data[4:8], "little")
    if size < max(needed, 30):
        raise ImageError(f"is cut off: this WebP has {size:,} bytes and needs {needed:,}. {COPY_AGAIN}")
    match data[12:16]:
        case b"VP8X":  # with alpha, EXIF or animation: 24 bits each, less one
            return Claim(int.from_bytes(data[27:30], "little") + 1, int.from_bytes(data[24:27], "little") + 1, 4)
        case b"VP8L":  # lossless: 14 bits each, less one
            bits = int.from_bytes(data[21:25], "little")
            return Claim((bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1, 4)
        case _:  # lossy: 14 bits each, and 2 of a scale
            width, height = struct.unpack_from("<HH", data, 26)
            return Claim(height & 0x3FFF, width & 0x3FFF, 4)
