"""What the tests of the server share: small limits, and files."""

import io
import struct
import zlib

import numpy as np

from mwdn.preview.limits import Limits

SIDE = 48
LIMITS = Limits(upload_bytes=200_000, frame_pixels=4 * SIDE**2, pixels=2 * SIDE**2, seconds=60.0, waiting=64, cameras=2)


def npy(array):
    """An array as the bytes of a file."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def png_claiming(width, height):
    """A small PNG that claims many pixels: a bomb."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(b"\0" * 10_000)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def hostile(capture):
    """Files that are no captures of a camera, by what is wrong with them, each with a word of the error.

    Args:
        capture: a good one, an NPY file of (side, side, 3) uint16.
    """
    frame = np.load(io.BytesIO(capture))
    side = len(frame)
    nan = frame.astype(np.float32) / 65_535
    nan[3, 4] = np.nan
    return {
        "empty": (b"", "capture"),
        "text": (b"#!/bin/sh\nrm -rf /", "PNG"),
        "truncated": (capture[:-50], "capture"),
        "bomb": (png_claiming(60_000, 60_000), "pixels"),
        "many pixels": (npy(np.zeros((side * 3, side * 3), np.uint8)), f"{4 * side**2:,}"),
        "not a number": (npy(nan), "NaN"),
        "pickle": (npy(np.array([{}], dtype=object)), "capture"),
        "dark": (npy(np.zeros((side, side, 3), np.uint16)), "light"),
        "other size": (npy(np.ones((side - 8, side, 3), np.uint16)), str(side)),
    }
