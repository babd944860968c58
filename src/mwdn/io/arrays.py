"""Frames from arrays and PIL pictures, and the axes, types and sizes that a frame may have."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.errors import FrameShapeError, FrameTypeError, ImageError, reason, shown
from mwdn.types import ArrayPicture, Frame

MAX_PIXELS = 2**28
"""16,384 x 16,384, more than any sensor has. In RGB that is 1.5 GiB of uint16 or 3 GiB of float32; a header that
claims more is damaged, or made to exhaust the reader's memory."""

_most_pixels = ContextVar("most_pixels", default=MAX_PIXELS)
_PIL_MODES = ("L", "RGB", "F", "I;16", "I;16L", "I;16B")


@contextmanager
def at_most_pixels(count: int) -> Iterator[None]:
    """Refuse frames with more pixels by their headers, in this thread; for files from untrusted senders."""
    token = _most_pixels.set(min(count, MAX_PIXELS))
    try:
        yield
    finally:
        _most_pixels.reset(token)


def frame_shape(shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[int, ...]:
    """(H, W, C) of a stored array; its header is checked before memory is allocated."""
    if dtype.kind != "f" and dtype.str[1:] not in ("u1", "u2"):
        raise FrameTypeError(
            f"holds {dtype}; a frame has uint8, uint16 or floats. Convert 8-bit values: `frame.astype('uint8')`, "
            "others to uint16: integers are divided by their type's maximum, floats are taken as they are."
        )
    axes = shape
    while axes[:1] == (1,) and (len(axes) > 3 or (len(axes) == 3 and axes[2] not in (1, 3, 4))):
        axes = axes[1:]
    axes = (*axes, 1) if len(axes) == 2 else axes
    if len(axes) != 3 or axes[2] not in (1, 3, 4) or min(axes) < 1:
        way_out = " The first one: `array[0]`." if len(axes) > 3 else ""
        way_out = " For channels first: `array.transpose(1, 2, 0)`." if axes[:1] in ((3,), (4,)) else way_out
        raise FrameShapeError(
            f"has the shape ({' x '.join(map(str, shape))}); one frame is (H, W) or (H, W, 1 or 3 channels).{way_out}"
        )
    if axes[0] * axes[1] > _most_pixels.get():
        raise ImageError(f"claims {axes[0]:,} x {axes[1]:,} pixels; at most {_most_pixels.get():,} are read. Crop it.")
    return axes


def without_alpha(pixels: Frame) -> Frame:
    """The first three of four channels. Alpha must be opaque: a transparent pixel has no certain colour."""
    opaque = 1.0 if pixels.dtype.kind == "f" else np.iinfo(pixels.dtype).max
    transparent = float((pixels[..., 3] < opaque).mean())
    if transparent > 0:
        raise ImageError(f"is transparent in {transparent:.1%} of its pixels (alpha). Save it without transparency.")
    return pixels[..., :3]


def to_frame(stored: Frame, axes: tuple[int, ...], *, copy: bool = True, photograph: bool = False) -> Frame:
    """Reshape to (H, W, C), drop alpha, and convert to native byte order and floats to float32."""
    pixels = stored.reshape(axes)
    pixels = pixels[..., :3] if photograph or axes[2] != 4 else without_alpha(pixels)
    dtype = np.dtype(np.float32) if stored.dtype.kind == "f" else stored.dtype.newbyteorder("=")
    with np.errstate(over="ignore"):  # a float64 beyond float32's range becomes infinity, which is refused later
        return pixels.astype(dtype, copy=copy, subok=False)


def as_frame(picture: ArrayPicture, *, finite: bool = True) -> Frame:
    """Convert a numpy array or a PIL picture to a frame, without a copy where its axes and type fit.

    Args:
        picture: (H, W) or (H, W, C) of 1 or 3 channels, RGB, row 0 at the top, uint8, uint16 or floats; a PIL picture
            of mode L, RGB, I;16 or F. Nothing is scaled, turned or decoded.
        finite: refuse NaN and infinity.

    Raises:
        FrameShapeError: other axes, for example a batch or alpha.
        FrameTypeError: numbers of other types (int32), or masked; a path; a tensor; a PIL picture of another mode.
        ImageError: NaN or infinity.
    """
    if isinstance(picture, str | Path):
        raise FrameTypeError(f"`{picture}` is a path, not a frame: `mwdn.read_frame('{picture}')`.")
    if hasattr(picture, "is_floating_point"):  # a tensor has another order of axes and another scale
        raise FrameTypeError(
            f"A frame ({shown(picture)}) must be an array (H, W, C), not a tensor: `tensor.movedim(0, -1).numpy()` for "
            "one (C, H, W). A tensor (B, C, H, W) of floats is a measurement already."
        )
    if np.ma.is_masked(picture):
        raise FrameTypeError(f"A frame ({shown(picture)}) must have no masked pixels. Fill them: `array.filled(0)`.")
    mode = "L" if isinstance(picture, np.ndarray) else getattr(picture, "mode", "L")  # a memmap's is that of its file
    if mode not in _PIL_MODES:  # Pillow has some pictures of 16 bits in mode I, and clips them for RGB
        way_out = "numpy.asarray(picture).astype('uint16')" if mode == "I" else "picture.convert('RGB')"
        raise FrameTypeError(f"The picture (mode {mode}) must be grey or RGB. Convert it: `{way_out}`.")
    try:
        stored = np.asarray(picture)
    except ValueError as error:  # lists of other lengths
        raise FrameShapeError(f"A frame ({shown(picture)}) must be an array (H, W, C): {reason(error)}.") from error
    try:
        if stored.dtype == object:
            raise FrameTypeError(f"({shown(picture)}) must hold numbers: uint8, uint16 or floats, (H, W) or (H, W, C).")
        if stored.ndim > 3:
            raise FrameShapeError(f"({' x '.join(map(str, stored.shape))}) must be (H, W, C). The first: `array[0]`.")
        if stored.ndim == 3 and stored.shape[2] == 4:
            raise FrameShapeError(f"{stored.shape} has four channels, a frame 1 or 3. Without alpha: `array[..., :3]`.")
        frame = to_frame(stored, frame_shape(stored.shape, stored.dtype), copy=False)
    except ImageError as error:
        raise type(error)(f"The array {error}") from error
    if finite and frame.dtype.kind == "f" and not np.isfinite(frame).all():
        raise ImageError("The array holds NaN or infinity. Replace them: `numpy.nan_to_num`.")
    return frame
