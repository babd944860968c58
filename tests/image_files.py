"""Image files, made by Pillow, tifffile and numpy."""

import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image as Pillow

HEIGHT, WIDTH = 37, 51
RED, BLUE = [255, 0, 0], [0, 0, 255]


def noise(dtype: str = "uint8", channels: int = 3) -> np.ndarray:
    full = np.random.default_rng(0).integers(0, 2**16, (HEIGHT, WIDTH, channels), dtype=np.uint16)
    return (full >> 8).astype(np.uint8) if dtype == "uint8" else full.astype(dtype)


def flag() -> np.ndarray:
    """Red at the top left, blue at the bottom left, in blocks that survive JPEG."""
    picture = np.zeros((32, 48, 3), np.uint8)
    picture[:16, :16], picture[16:, :16] = RED, BLUE
    return picture


def encoded(array: np.ndarray, kind: str, **options: object) -> bytes:
    data = BytesIO()
    Pillow.fromarray(array).save(data, kind, **options)
    return data.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png16(array: np.ndarray) -> bytes:
    """Made by hand from the PNG specification: Pillow knows no colour of 16 bits."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in array)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", array.shape[1], array.shape[0], 16, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def tiff(array: np.ndarray, **options: object) -> bytes:
    data = BytesIO()
    tifffile.imwrite(data, array, **{"photometric": "minisblack"} | options)
    return data.getvalue()


def dng(mosaic: np.ndarray, colours: str = "rggb", *, black: int = 64, white: int = 1023, turn: int = 1) -> bytes:
    """A raw file with the tags that LibRaw needs; a grey sensor and a linear DNG (H, W, 3) have no ``colours``."""
    byte, ascii_, short, long = 1, 2, 3, 4
    tags = [
        (50706, byte, 4, bytes([1, 4, 0, 0]), True),  # version of DNG
        (50708, ascii_, 0, "mwdn test", True),  # camera
        (50714, long, 1, black, True),
        (50717, long, 1, white, True),
        (274, short, 1, turn, True),  # EXIF orientation
    ]
    if colours:
        pattern = bytes("rgb".index(letter) for letter in colours)
        side = int(len(colours) ** 0.5)
        tags += [(33421, short, 2, (side, side), True), (33422, byte, len(colours), pattern, True)]
    data = BytesIO()
    mosaic_, linear = 32803, 34892
    kind = linear if mosaic.ndim == 3 else mosaic_
    tifffile.imwrite(data, mosaic, photometric=kind, planarconfig=None, extratags=tags, metadata=None)
    if colours or kind == linear:
        return data.getvalue()
    grey = [struct.pack("<HHIHxx", 262, 3, 1, photometric) for photometric in (mosaic_, linear)]  # not in tifffile
    return data.getvalue().replace(*grey)


def npy(array: np.ndarray, **options: bool) -> bytes:
    data = BytesIO()
    np.save(data, array, **options)
    return data.getvalue()


def put(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
