"""Pictures and frames in and out of files. A file's content, not its name, decides how it is read."""

import logging
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mwdn.data.writing import save_linear, save_png
from mwdn.errors import ImageError, ParameterError
from mwdn.types import FloatFrame, Frame, Image

READABLE = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".npy"})
"""Suffixes, in lower case, by which a folder is searched for pictures and frames."""

# 16,384 x 16,384, more than any sensor has. In RGB that is 1.5 GiB of uint16 or 3 GiB of float32; a header
# that claims more is damaged, or made to exhaust the memory of whoever opens it.
MAX_PIXELS = 2**28

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "PNG", b"\xff\xd8\xff": "JPEG", b"BM": "BMP", b"\x93NUMPY": "NPY"}
_SIGNATURES |= dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "TIFF")  # + is BigTIFF
_JPEG_MARKER = re.compile(rb"\xff[\x02-\xcf\xd8-\xfe]")  # FF 00 and FF D0 to D7 belong to the compressed data
_AGAIN = "Copy it from its source again."

# tifffile logs each odd tag. Without a handler those lines would reach the terminal beside our one message.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


def read_frame(path: str | Path, *, bgr: bool = False, upside_down: bool = False, upright: bool = False) -> Frame:
    """Read a frame, its numbers exactly as stored: no gamma, no scaling.

    Args:
        path: PNG, JPEG, BMP, TIFF (its first picture) or NPY.
        bgr: the file's channels are blue, green, red, against its format's custom.
        upside_down: the file's first row is the picture's last. DiffuserCam's ``.npy`` files need both.
        upright: turn a photograph as its EXIF says; a sensor's frame stays as it lies.

    Returns:
        (H, W, 1) or (H, W, 3), RGB, row 0 at the top, uint8 or uint16 as stored, any float as float32.
        Grey has one channel, alpha is dropped, leading axes of length 1 are removed.

    Raises:
        ImageError: no such file; damaged, cut off, or of an unknown format; other numbers or axes than these;
            more than `MAX_PIXELS` pixels; NaN or infinity.
    """
    frame = _read(Path(path), photograph=upright)
    return np.ascontiguousarray(frame[:: -1 if upside_down else 1, :, :: -1 if bgr else 1])


def decode_frame(data: bytes, name: str) -> Frame:
    """Read a frame from the bytes of a file, its numbers exactly as stored.

    Args:
        data: whole content of a PNG, JPEG or BMP.
        name: of where the bytes come from, for the message.

    Returns:
        (H, W, 1) or (H, W, 3), as for `read_frame`.

    Raises:
        ImageError: damaged, cut off, or of another format.
    """
    kind = next((kind for sign, kind in _SIGNATURES.items() if data.startswith(sign)), "unknown")
    try:
        if kind not in ("PNG", "JPEG", "BMP"):
            raise ImageError(f"must be PNG, JPEG or BMP, but starts with {data[:8]!r}. Export it as PNG.")
        return np.ascontiguousarray(_decode(kind, data, photograph=False))
    except ImageError as problem:
        raise ImageError(f"{name} {problem}") from problem


def read_picture(path: str | Path) -> Image:
    """Read a photograph as linear light: turned upright as its EXIF says, decoded from sRGB.

    Args:
        path: PNG, JPEG, BMP, TIFF (its first picture) or NPY, of 8 or 16 bits.

    Returns:
        (1, 3, H, W), in [0, 1]; 1 is the largest number of 8 or 16 bits. Grey is repeated, alpha dropped.

    Raises:
        ImageError: as for `read_frame`, or the file holds floats, for which no gamma is customary.
    """
    pixels = _read(Path(path), photograph=True)
    if pixels.dtype.kind == "f":
        raise ImageError(f"`{path}` holds floats; a photograph has 8 or 16 bits. Read it with `read_frame`.")
    peak = np.iinfo(pixels.dtype).max
    light = srgb_decode(torch.arange(peak + 1) / peak).numpy()[pixels]  # one power a level, not a pixel
    return torch.from_numpy(light).movedim(-1, 0)[None].expand(-1, 3, -1, -1).contiguous()


def write_picture(path: str | Path, image: Tensor, *, bits: int = 8) -> None:
    """Write a picture for people: clipped to [0, 1], encoded as sRGB, rounded, as PNG, atomically.

    Args:
        path: ends in ``.png``; missing folders are created.
        image: (1, C, H, W) or (C, H, W) of 1 or 3 channels, linear light.
        bits: 8, or 16 for a picture that will be edited.

    Raises:
        ParameterError: ``bits`` is neither.
        ImageError: another suffix or shape, integers, NaN or infinity, or the disk refuses.
    """
    if bits not in (8, 16):
        raise ParameterError(f"`bits` ({bits}) must be 8 or 16, the depths of a PNG in colour.")
    frame = _writable(Path(path), image, ".png")
    encoded = srgb_encode(torch.from_numpy(frame)).mul(2**bits - 1).round().numpy()
    _write(save_png, Path(path), encoded.astype(f"uint{bits}"))


def write_linear(path: str | Path, image: Tensor) -> None:
    """Write a picture for measuring: its exact float32 numbers, which `read_frame` gives back, atomically.

    Args:
        path: ends in ``.tif``, ``.tiff`` or ``.npy``; missing folders are created.
        image: (1, C, H, W) or (C, H, W) of 1 or 3 channels, any range; stored as (H, W, C).

    Raises:
        ImageError: another suffix or shape, integers, NaN or infinity, or the disk refuses.
    """
    _write(save_linear, Path(path), _writable(Path(path), image, ".npy", ".tif", ".tiff"))


def srgb_encode(linear: Tensor) -> Tensor:
    """From linear light to the numbers of an sRGB file, of any shape; clipped to [0, 1].

    References:
        IEC 61966-2-1:1999, section 5.2: a line in the dark, then a power of 1 / 2.4. 0.2140 becomes 0.5.
    """
    linear = linear.clamp(0, 1)
    power = linear ** (1 / 2.4)
    # 1.055 power - 0.055, in a form that makes white exactly 1 in float32 too.
    return torch.where(linear <= 0.0031308, 12.92 * linear, power + 0.055 * (power - 1))


def srgb_decode(encoded: Tensor) -> Tensor:
    """From the numbers of an sRGB file, of any shape and in [0, 1], to linear light; undoes `srgb_encode`."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _read(path: Path, *, photograph: bool) -> Frame:
    """Read any file. What the functions below say is wrong gets the file's name put before it here."""
    try:
        match _kind(path):
            case "NPY":
                frame = _read_npy(path)
            case "TIFF":
                frame = _read_tiff(path, photograph)
            case kind:
                frame = _decode(kind, path.read_bytes(), photograph)
        if not np.isfinite(frame).all():
            raise ImageError("holds NaN or infinity. Capture it again, or mend it with `numpy.nan_to_num`.")
    except ImageError as problem:
        raise ImageError(f"`{path}` {problem}") from problem
    except OSError as error:
        raise ImageError(f"`{path}` cannot be read: {error.strerror}. Check its permissions.") from error
    return frame


def _kind(path: Path) -> str:
    if not path.exists():
        raise ImageError(f"does not exist. Check the name; the current folder is `{Path.cwd()}`.")
    if not path.is_file():
        raise ImageError("must be a file, but is a folder or a device. Name one file inside it.")
    with path.open("rb") as file:
        start = file.read(8)
    if not start:
        raise ImageError(f"is empty (0 bytes). {_AGAIN}")
    if kind := next((kind for sign, kind in _SIGNATURES.items() if start.startswith(sign)), None):
        return kind
    raise ImageError(f"must be PNG, JPEG, BMP, TIFF or NPY, but starts with {start!r}. Export it as PNG.")


def _frame_shape(shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[int, ...]:
    """(H, W, C) of a stored array, judged by its header before any memory is spent on it."""
    if dtype.kind != "f" and dtype.str[1:] not in ("u1", "u2"):
        raise ImageError(f"holds {dtype}; a frame has uint8, uint16 or floats. Convert it with `astype`.")
    axes = shape
    while axes[:1] == (1,) and (len(axes) > 3 or (len(axes) == 3 and axes[2] not in (1, 3, 4))):
        axes = axes[1:]
    axes = (*axes, 1) if len(axes) == 2 else axes
    if len(axes) != 3 or axes[2] not in (1, 3, 4) or min(axes) < 1:
        got, wanted = " x ".join(map(str, shape)), "(height, width) or (height, width, 1 or 3 channels)"
        raise ImageError(f"has the axes ({got}); a frame has {wanted}. Save one frame, channels last.")
    if axes[0] * axes[1] > MAX_PIXELS:
        raise ImageError(f"claims {axes[0]:,} x {axes[1]:,} pixels; at most {MAX_PIXELS:,} are read. Crop it.")
    return axes


def _as_frame(stored: Frame, axes: tuple[int, ...]) -> Frame:
    dtype = np.dtype(np.float32) if stored.dtype.kind == "f" else stored.dtype.newbyteorder("=")
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinity, which `_read` refuses
        return np.array(stored.reshape(axes)[..., :3], dtype)


def _read_npy(path: Path) -> Frame:
    try:
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        raise ImageError(f"is no whole NPY of plain numbers ({error}). Copy or save it again.") from error
    return _as_frame(stored, _frame_shape(stored.shape, stored.dtype))


def _read_tiff(path: Path, photograph: bool) -> Frame:
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            axes, planar, orientation = _tiff_axes(file)
            # tifffile is exact for every kind of number; LZW, JPEG and PackBits it leaves to OpenCV.
            plain = file.pages[0].compression in (1, 8, 32946)
            stored = file.series[0].asarray() if plain else _decode_tiff(path)
            planar = planar and plain
    except ImageError:
        raise
    except Exception as error:  # a damaged file makes tifffile raise struct.error, ValueError, KeyError ...
        raise ImageError(f"cannot be read as TIFF: {error}. {_AGAIN}") from error
    frame = _as_frame(np.moveaxis(stored, -3, -1) if planar else stored, axes)
    return _upright(frame, orientation) if photograph else frame


def _decode_tiff(path: Path) -> Frame:
    import cv2

    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ImageError(f"is damaged: OpenCV cannot decode this TIFF. {_AGAIN}")
    pixels = np.atleast_3d(pixels)
    return np.ascontiguousarray(pixels[..., 2::-1] if pixels.shape[2] >= 3 else pixels)


def _upright(frame: Frame, orientation: int) -> Frame:
    frame = frame.swapaxes(0, 1) if 5 <= orientation <= 8 else frame
    return frame[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def _tiff_axes(file: Any) -> tuple[tuple[int, ...], bool, int]:  # noqa: ANN401
    """(H, W, C) of a TIFF's first picture, whether its channels come first, and its EXIF orientation."""
    pages, handle = file.pages, file.filehandle
    # Where the chain of pages breaks off, tifffile shows those before: of a picture in planes, red alone.
    if len(pages) == 0 or (handle.seek(pages.next_page_offset) and any(handle.read(file.tiff.offsetsize))):
        raise ImageError(f"is cut off: its list of pages leads past its end. {_AGAIN}")
    if pages[0].photometric not in (1, 2, 32803, 34892):  # grey, RGB, two kinds of raw mosaic
        colours = getattr(pages[0].photometric, "name", pages[0].photometric)
        raise ImageError(f"stores its colours as {colours}. Save it as RGB, or as grey with black at 0.")
    shape, planar = file.series[0].shape, file.series[0].axes[-3:] in ("SYX", "CYX")
    shape = (*shape[:-3], *shape[-2:], shape[-3]) if planar else shape
    return _frame_shape(shape, file.series[0].dtype), planar, int(pages[0].tags.valueof(274, 1))


def _decode(kind: str, data: bytes, photograph: bool) -> Frame:
    import cv2

    _frame_shape({"PNG": _png_size, "JPEG": _jpeg_size, "BMP": _bmp_size}[kind](data), np.dtype(np.uint8))
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH if photograph else cv2.IMREAD_UNCHANGED
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"cannot be decoded as {kind}: {error.err}. {_AGAIN}") from error
    if pixels is None:
        raise ImageError(f"is damaged: OpenCV cannot decode this {kind}. {_AGAIN}")
    pixels = np.atleast_3d(pixels)
    if pixels.shape[2] == 1 or (kind == "PNG" and data[25] in (0, 4)):  # OpenCV makes grey with alpha BGRA
        return pixels[..., :1]
    return pixels[..., 2::-1]  # from BGR or BGRA


def _png_size(data: bytes) -> tuple[int, int]:
    view, position, kind = memoryview(data), 8, b""
    while kind != b"IEND":
        end, kind = position + 12 + int.from_bytes(view[position:][:4]), bytes(view[position + 4 :][:4])
        if end > len(data):
            raise ImageError(f"is cut off: after {len(data):,} bytes this PNG has no end (IEND). {_AGAIN}")
        # An upper-case first letter marks the chunks without which there is no picture.
        if kind[:1].isupper() and zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(view[end - 4 : end]):
            raise ImageError(f"is damaged: the checksum of {kind!r} at byte {position:,} is wrong. {_AGAIN}")
        position = end
    return int.from_bytes(data[20:24]), int.from_bytes(data[16:20])


def _jpeg_size(data: bytes) -> tuple[int, int]:
    position, size = 2, b""
    while marker := _JPEG_MARKER.search(data, position):
        code, position = marker.group()[1], marker.end()
        if code == 0xD9:
            return int.from_bytes(size[:2]), int.from_bytes(size[2:])
        if 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC):  # the start of a frame, not a table
            size = data[position + 3 : position + 7]
        position += int.from_bytes(data[position : position + 2])  # past a thumbnail, which has an end of its own
    raise ImageError(f"is cut off: after {len(data):,} bytes this JPEG has no end (FF D9). {_AGAIN}")


def _bmp_size(data: bytes) -> tuple[int, int]:
    head = data[:34].ljust(34, b"\0")
    start, header = struct.unpack_from("<II", head, 10)
    width, height, _, bits = struct.unpack_from("<4H" if header == 12 else "<iiHH", head, 18)
    packed = header > 12 and head[30] not in (0, 3)  # in run lengths, whose sum only the decoder knows
    needed = start + (0 if packed else (width * bits + 31) // 32 * 4 * abs(height))  # rows of whole 4 bytes
    if len(data) < max(needed, 26):
        raise ImageError(f"is cut off: this BMP has {len(data):,} bytes and needs {needed:,}. {_AGAIN}")
    return abs(height), width  # a negative height puts the top row first


def _writable(path: Path, image: Tensor, *suffixes: str) -> FloatFrame:
    if path.suffix.lower() not in suffixes:
        raise ImageError(f"`{path}` must end in {' or '.join(suffixes)}, not '{path.suffix}'. Rename it.")
    picture = image[0] if image.ndim == 4 and len(image) == 1 else image
    fits = picture.ndim == 3 and len(picture) in (1, 3) and picture.numel() > 0
    if not (fits and picture.is_floating_point()):
        got = f"{' x '.join(map(str, image.shape))}, {image.dtype}"
        wanted = "(C, H, W) or (1, C, H, W), floats of 1 or 3 channels"
        raise ImageError(f"`image` ({got}) must be {wanted} for `{path}`. Pick one of the batch.")
    picture = picture.detach().to("cpu", torch.float32)
    if not torch.isfinite(picture).all():
        raise ImageError(f"`image` holds NaN or infinity: `{path}` is not written. Use `torch.nan_to_num`.")
    return picture.movedim(0, -1).contiguous().numpy()


def _write(save: Callable[[Path, Frame], None], path: Path, pixels: Frame) -> None:
    try:
        save(path, pixels)
    except OSError as error:
        why = error.strerror or error
        raise ImageError(f"`{path}` cannot be written: {why}. Choose another folder.") from error
