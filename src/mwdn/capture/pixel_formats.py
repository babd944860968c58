"""Names of raw pixel formats (GenICam, libcamera, V4L2), and the frames in their buffers."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mwdn.errors import CameraError
from mwdn.io.raw import Mosaic


class PixelFormat(NamedTuple):
    """An unpacked raw format: each number has its own 8 or 16 bits, in the order of the computer.

    Args:
        bit_depth: bits of the sensor.
        mosaic: colours of a 2 x 2 cell.
        channels: numbers per pixel, 1 or 3 (RGB).
    """

    bit_depth: int
    mosaic: Mosaic | None = None
    channels: int = 1

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers."""
        return np.dtype(np.uint8 if self.bit_depth <= 8 else "<u2")


_CELLS: dict[str, Mosaic] = {"RG": "rggb", "BG": "bggr", "GR": "grbg", "GB": "gbrg"}
_V4L2: dict[str, PixelFormat] = {
    "GREY": PixelFormat(8),
    "RGGB": PixelFormat(8, "rggb"),
    "BA81": PixelFormat(8, "bggr"),
    "GRBG": PixelFormat(8, "grbg"),
    "GBRG": PixelFormat(8, "gbrg"),
    **{f"Y{bits} ": PixelFormat(bits) for bits in (10, 12, 14, 16)},
    **{f"{cell}{bits}": PixelFormat(bits, order) for cell, order in _CELLS.items() for bits in (10, 12, 14, 16)},
    **{f"BA{bits}": PixelFormat(bits, "grbg") for bits in (10, 12)},  # V4L2's names of GRBG, older than "GR"
    "BYR2": PixelFormat(16, "bggr"),
}


def genicam_format(name: str) -> PixelFormat | None:
    """A format by its name in GenICam's convention, ``Mono12`` or ``BayerRG8``; ``None`` if packed or unknown.

    References:
        EMVA, GenICam Pixel Format Naming Convention 2.1: a suffix p or Packed marks packed formats.
    """
    match = re.fullmatch(r"(Mono|Bayer(RG|BG|GR|GB)|RGB)(8|10|12|14|16)", name)
    if match is None:
        return None
    mosaic = _CELLS[match[2]] if match[2] else None
    return PixelFormat(int(match[3]), mosaic, 3 if match[1] == "RGB" else 1)


def libcamera_format(name: str) -> PixelFormat | None:
    """A format of a Raspberry Pi, ``SRGGB12`` or ``R10``; ``None`` if packed (``_CSI2P``), compressed or unknown."""
    match = re.fullmatch(r"S?(RGGB|BGGR|GRBG|GBRG|R)(8|10|12|14|16)", name)
    if match is None:
        return None
    return PixelFormat(int(match[2]), None if match[1] == "R" else match[1].lower())  # type: ignore[arg-type]


def v4l2_format(fourcc: str) -> PixelFormat | None:
    """A raw format of V4L2 by its four characters, ``"RG10"``; ``None`` if packed (``pRAA``) or unknown."""
    return _V4L2.get(fourcc.ljust(4))


def choose_format(names: Iterable[str], wanted: str, camera: str) -> tuple[str, PixelFormat]:
    """The format to use: the wanted one, or the raw one with the most bits, colour filters first.

    Args:
        names: GenICam formats that the camera offers.
        wanted: one of them, or empty.
        camera: for the message.

    Raises:
        CameraError: the camera has no such format, or it is packed.
    """
    offered = list(names)
    usable = {name: found for name in offered if (found := genicam_format(name))}
    if wanted and wanted not in usable:
        raise CameraError(
            f"{camera} has no unpacked raw format '{wanted}'. Choose one: {', '.join(usable) or 'none of its own'}."
        )
    if not usable:
        raise CameraError(f"{camera} offers no unpacked raw format, only {', '.join(offered)[:120]}.")
    raw = {name: found for name, found in usable.items() if found.channels == 1} or usable
    chosen = wanted or max(raw, key=lambda name: (raw[name].mosaic is not None, raw[name].bit_depth))
    return chosen, usable[chosen]


def unpack(data: Any, format: PixelFormat, size: tuple[int, int], stride: int = 0) -> npt.NDArray[Any]:  # noqa: ANN401
    """The frame (H, W, C) in a buffer; a copy, so the buffer can be filled again.

    Args:
        data: bytes, or an array of any type and shape.
        format: of the pixels.
        size: height and width.
        stride: bytes from one row to the next; 0 if rows follow without a gap.

    Raises:
        CameraError: the buffer is shorter.
    """
    height, width = size
    row = width * format.channels * format.dtype.itemsize
    stride = stride or row
    flat = np.frombuffer(np.ascontiguousarray(data) if isinstance(data, np.ndarray) else data, np.uint8)
    needed = stride * (height - 1) + row
    if stride < row or len(flat) < needed:
        raise CameraError(f"A frame of {height} x {width} pixels needs {needed:,} bytes, but {len(flat):,} came.")
    rows = np.lib.stride_tricks.as_strided(flat, (height, row), (stride, 1))
    pixels = np.ascontiguousarray(rows).view(format.dtype)
    return pixels.reshape(height, width, format.channels).astype(format.dtype.newbyteorder("="), copy=False)
