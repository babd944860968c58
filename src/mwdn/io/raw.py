"""Raw files of cameras, by rawpy (LibRaw): the numbers of the sensor, before any processing."""

import io
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast, get_args

import numpy as np

from mwdn.errors import ImageError, cut, one_line, reason
from mwdn.io.decoder_messages import decoder_messages
from mwdn.io.headers import COPY_AGAIN, MAX_DECODED_BYTES, check_decoded
from mwdn.io.reading import read_bytes
from mwdn.runtime.requirement import require
from mwdn.types import Frame

RAW = frozenset({".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef"})
"""Suffixes, in lower case, of raw files. Most of them are TIFFs inside, so the content does not identify them."""

RAW_WHITE = 65535
"""The number at which the sensor saturates, after scaling. 14 bits become 16: a step of the sensor is 4 numbers."""

Mosaic = Literal["rggb", "bggr", "grbg", "gbrg"]
"""Colour filter arrays: the colours of a 2 x 2 cell, row by row."""


class RawFrame(NamedTuple):
    """The frame of a raw file, and the order of its colours.

    Args:
        frame: (H, W, 1), uint16, the visible part of the sensor: 0 is the file's black level, `RAW_WHITE` its white
            level. Noise below the black level becomes 0. (H, W, 3), RGB, from a linear DNG such as a phone's ProRAW.
        mosaic: colours of a 2 x 2 cell, row by row, ``"rggb"``; H and W are then even. ``None`` for a grey sensor and
            for a linear DNG.
    """

    frame: Frame
    mosaic: Mosaic | None


def is_raw(path: str | Path) -> bool:
    """Whether a file is named like a camera's raw file."""
    return Path(path).suffix.lower() in RAW


def read_raw(path: str | Path) -> RawFrame:
    """Read the numbers of the sensor from a raw file, without demosaicing, white balance or gamma.

    Raises:
        MissingPackageError: rawpy is not installed.
        ImageError: the file cannot be read, or its mosaic is not of 2 x 2 pixels.
    """
    rawpy = require("rawpy", "raw", purpose=f"`{path}`, a camera's raw file,")
    data = read_bytes(path, most=MAX_DECODED_BYTES)
    try:
        with decoder_messages() as lines, rawpy.imread(io.BytesIO(data)) as file:
            _check_size(file, len(data))
            frame = _scaled(file)
        if lines:
            raise ImageError(f"is damaged: {cut(one_line(lines[0]), 120)}. {COPY_AGAIN}")
    except ImageError as error:
        raise ImageError(f"`{path}` {error}") from error
    except Exception as error:  # a damaged file makes rawpy and numpy raise anything
        said = error.args[0] if error.args else ""
        why = cut(one_line(said.decode(errors="replace")), 120) if isinstance(said, bytes) else reason(error)
        raise ImageError(
            f"`{path}` cannot be read as a raw file: {why}. Check the name, or copy it from its source again."
        ) from error
    return frame


def _check_size(file: Any, stored: int) -> None:  # noqa: ANN401
    """Refuse a raw file that claims more pixels than it can hold, before they are unpacked."""
    sizes = file.sizes
    check_decoded(sizes.raw_height * sizes.raw_width * 8, stored)  # LibRaw keeps up to four numbers of 16 bits


def _scaled(file: Any) -> RawFrame:  # noqa: ANN401
    """The visible part of the sensor, its black level at 0 and its white level at `RAW_WHITE`."""
    stored, black = file.raw_image_visible, np.asarray(file.black_level_per_channel, np.float32)
    mosaic = None
    if stored.ndim == 3:  # a linear DNG: the camera has demosaiced it, and pads RGB to four numbers
        stored, black = stored[..., :3], black[:3]
    elif file.raw_pattern.shape == (1, 1):
        stored, black = stored[..., None], black[:1]
    else:
        mosaic = _mosaic(file)
        height, width = (side // 2 * 2 for side in stored.shape)
        stored = stored[:height, :width, None]
        black = np.tile(black[file.raw_pattern], (height // 2, width // 2))[..., None]
    if not file.white_level > black.max():
        raise ImageError(f"has a white level ({file.white_level}) that is not above its black level ({black.max():g}).")
    light = (stored - black) * (RAW_WHITE / (file.white_level - black))
    return RawFrame(np.rint(light.clip(0, RAW_WHITE)).astype(np.uint16), mosaic)


def _mosaic(file: Any) -> Mosaic:  # noqa: ANN401
    """Colours of a 2 x 2 cell."""
    pattern = file.raw_pattern
    letters = "".join(chr(file.color_desc[index]) for index in pattern.flat).lower()
    if letters not in get_args(Mosaic):
        side = " x ".join(map(str, pattern.shape))
        raise ImageError(f"has a mosaic of {side} ({letters[:4]} ...), not 2 x 2 (rggb). Export it as 16-bit TIFF.")
    return cast(Mosaic, letters)
