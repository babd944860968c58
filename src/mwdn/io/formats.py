"""Readers of pictures and arrays. The format is taken from the content, and the header is checked first."""

import logging
import math
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mwdn.errors import ImageError, cut, one_line, reason
from mwdn.io.arrays import frame_shape, to_frame, without_alpha
from mwdn.io.decoder_messages import decoder_messages
from mwdn.io.exif import orientation_in, upright
from mwdn.io.headers import COPY_AGAIN, MAX_HEADER_BYTES, check_decoded, check_whole, picture_claim
from mwdn.io.npy import read_npy
from mwdn.io.raw import is_raw, read_raw
from mwdn.io.reading import open_regular
from mwdn.io.tiff import read_tiff
from mwdn.types import Frame

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "PNG", b"\xff\xd8\xff": "JPEG", b"BM": "BMP", b"\x93NUMPY": "NPY"}
_SIGNATURES |= dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "TIFF")  # + is BigTIFF
_SIGNATURES |= dict.fromkeys((b"P5\n", b"P6\n", b"P5 ", b"P6 "), "PGM")
_PGM_HEADER = re.compile(rb"P([56])" + 3 * rb"\s+(?:#[^\n]*\n\s*)*(\d{1,9})" + rb"\s")
_PNG_DAMAGE = re.compile("libpng error|IDAT|image data")
# tifffile logs unusual tags. Without a handler these lines would reach the terminal.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


def read(path: Path, *, photograph: bool) -> Frame:
    """Read any file as it is stored, (H, W, 1) or (H, W, 3), RGB.

    The functions below raise `ImageError` without the file's name, which is added here.

    Args:
        path: of the file.
        photograph: rotate it according to its EXIF orientation, and resolve palettes. Raw files are refused.

    Raises:
        ImageError: it cannot be read, is damaged, or holds NaN or infinity.
    """
    if is_raw(path):
        return _read_raw(path, photograph)
    with open_regular(path) as file:
        try:
            return _read(file, photograph)
        except ImageError as error:
            raise type(error)(f"`{path}` {error}") from error
        except OSError as error:
            raise ImageError(f"`{path}` cannot be read: {error.strerror or reason(error)}. {COPY_AGAIN}") from error
        except MemoryError as error:
            raise ImageError(f"`{path}` does not fit into the memory that is left. Crop it.") from error
        except Exception as error:  # a damaged file makes tifffile, numpy and OpenCV raise anything
            what = f"{type(error).__name__}: {reason(error)}"
            raise ImageError(f"`{path}` cannot be read, it may be damaged ({what}). {COPY_AGAIN}") from error


def _read(file: BinaryIO, photograph: bool) -> Frame:
    kind = _kind(file.read(12))
    file.seek(0)
    match kind:
        case "NPY":
            stored = read_npy(file, frame_shape)
            frame = to_frame(stored, frame_shape(stored.shape, stored.dtype), photograph=photograph)
        case "TIFF":
            stored, orientation = read_tiff(file, frame_shape)
            frame = to_frame(stored, frame_shape(stored.shape, stored.dtype), copy=False, photograph=photograph)
            frame = upright(frame, orientation) if photograph else frame
        case _:
            frame = decode(kind, _content(kind, file), photograph)
            file.seek(0)
            frame = upright(frame, orientation_in(file)) if photograph else frame
    if not np.isfinite(frame).all():
        raise ImageError("holds NaN or infinity. Capture it again, or replace them with `numpy.nan_to_num`.")
    return frame


def kind_of(start: bytes) -> str | None:
    """Name of the format whose files start with these bytes, or ``None``."""
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return "WebP"
    return next((kind for signature, kind in _SIGNATURES.items() if start.startswith(signature)), None)


def is_for_viewing(file: str | Path | bytes) -> bool:
    """Whether a file, or its content, is a JPEG or WebP, which cameras and programs write gamma-coded."""
    if isinstance(file, bytes):
        return kind_of(file[:12]) in ("JPEG", "WebP")
    with suppress(OSError, ImageError), open_regular(file) as opened:  # reading the pixels reports the error
        return is_for_viewing(opened.read(12))
    return False


def _kind(start: bytes) -> str:
    if not start:
        raise ImageError(f"is empty (0 bytes). {COPY_AGAIN}")
    if kind := kind_of(start):
        return kind
    raise ImageError(
        f"must be PNG, JPEG, WebP, BMP, PGM, PPM, TIFF, NPY or a camera's raw file, but starts with {start[:8]!r}. "
        "Export it, or the frames of a video, as PNG."
    )


def _content(kind: str, file: BinaryIO) -> bytes:
    """All bytes of a file, if its header allows that many."""
    size, start = os.fstat(file.fileno()).st_size, file.read(MAX_HEADER_BYTES)
    needed = math.prod(_check_claim(kind, start, size))
    if size > 2 * needed + MAX_HEADER_BYTES:
        raise ImageError(f"has {size:,} bytes, too many for a picture of {needed:,}. {COPY_AGAIN}")
    return start + file.read(size - len(start)) if size > len(start) else start


def _check_claim(kind: str, start: bytes, size: int) -> tuple[int, int, int]:
    """Height, width and decoded bytes of a pixel from the header, if they can be read."""
    claim = _pgm_header(start)[:3] if kind == "PGM" else picture_claim(kind, start, size)
    frame_shape(claim[:2], np.dtype(np.uint8))
    check_decoded(math.prod(claim), size)
    return claim


def _read_raw(path: Path, photograph: bool) -> Frame:
    if photograph:
        raise ImageError(f"`{path}` is a camera's raw file, not a photograph for display. Export it as JPEG.")
    return read_raw(path).frame


def decode(kind: str, data: bytes, photograph: bool) -> Frame:
    """Read a whole PNG, JPEG, WebP, BMP, PGM or PPM.

    Args:
        kind: from `kind_of`.
        data: content of the file.
        photograph: as in `read`.

    Raises:
        ImageError: cut off or damaged; the message does not name the file.
    """
    _check_claim(kind, data, len(data))
    if kind == "PGM":
        return _read_pgm(data, photograph)
    check_whole(kind, data)
    pixels = np.atleast_3d(_decode(kind, data, photograph))
    pixels = without_alpha(pixels) if pixels.shape[2] == 4 else pixels
    if pixels.shape[2] == 1 or (kind == "PNG" and data[25] in (0, 4)):  # OpenCV decodes grey with alpha as BGRA
        return pixels[..., :1]
    return pixels[..., ::-1]  # from BGR


def _decode(kind: str, data: bytes, photograph: bool) -> Frame:
    import cv2

    # OpenCV turns JPEG and PNG, version 4 no WebP: `upright` turns all.
    as_shown = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    flags = as_shown if photograph else cv2.IMREAD_UNCHANGED
    set_level = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel  # of OpenCV 4, 5
    try:
        with decoder_messages() as lines:
            level = set_level(0)  # silent: its lines are C++
            try:
                pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
            finally:
                set_level(level)
    except cv2.error as error:
        raise ImageError(f"cannot be decoded as {kind}: {one_line(error.err)}. {COPY_AGAIN}") from error
    # libjpeg warns of nothing but damage and unknown extensions; libpng also of odd colour profiles.
    damage = [line for line in lines if kind == "JPEG" or _PNG_DAMAGE.search(line)]
    if damage:
        why = cut(one_line(damage[0]), 100)
        raise ImageError(f"is damaged: {why}. {COPY_AGAIN} If it looks whole in a viewer, save it as PNG there.")
    if pixels is None:
        raise ImageError(f"is damaged: OpenCV cannot decode this {kind}. {COPY_AGAIN}")
    return pixels


def _pgm_header(data: bytes) -> tuple[int, int, int, int, int, int]:
    """Height, width, bytes of a pixel, channels, the largest number, and the position of the numbers."""
    header = _PGM_HEADER.match(data[: 2**16])
    if header is None:
        raise ImageError(f"is damaged: this PGM or PPM has no width, height and largest number. {COPY_AGAIN}")
    kind, width, height, largest = map(int, header.groups())
    if not 0 < largest <= 65535:
        raise ImageError(f"is damaged: the largest number of this PGM or PPM ({largest:,}) must be 1 to 65,535.")
    channels = 1 if kind == 5 else 3
    return height, width, channels * (1 if largest < 256 else 2), channels, largest, header.end()


def _read_pgm(data: bytes, photograph: bool) -> Frame:
    """A binary PGM (grey) or PPM (RGB): a header in text, then the numbers, the high byte of 16 bits first.

    The header's largest number is white: a photograph is scaled to it.
    """
    height, width, pixel_bytes, channels, largest, start = _pgm_header(data)
    needed = start + height * width * pixel_bytes
    if len(data) < needed:
        raise ImageError(f"is cut off: this PGM or PPM has {len(data):,} bytes and needs {needed:,}. {COPY_AGAIN}")
    dtype = np.dtype(np.uint8 if pixel_bytes == channels else ">u2")
    frame = to_frame(np.frombuffer(data[start:needed], dtype), (height, width, channels))
    peak = np.iinfo(frame.dtype).max
    if not photograph or largest == peak:
        return frame
    return np.rint(frame.clip(max=largest) * np.float32(peak / largest)).astype(frame.dtype)
