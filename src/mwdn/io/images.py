"""Read and write pictures (sRGB) and frames (numbers as stored)."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.errors import ImageError, ParameterError
from mwdn.io.arrays import as_frame
from mwdn.io.files import atomic_write
from mwdn.io.formats import decode, kind_of, read
from mwdn.types import FloatFrame, Frame, Image

READABLE = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".npy"})
"""Suffixes, in lower case, of the files in a folder that are taken for pictures; frames may be `RAW`, too."""


@checked
def read_frame(path: str | Path, *, bgr: bool = False, upside_down: bool = False, upright: bool = False) -> Frame:
    """Read a frame, its numbers exactly as stored: no gamma, no scaling except of raw files.

    Args:
        path: PNG, JPEG, WebP, BMP, PGM, PPM, TIFF (one picture; smaller copies of it are ignored), NPY, or a
            camera's raw file (`mwdn.io.raw`): the mosaic of the sensor as one channel, with the black level at 0 and
            the white level at 65,535.
        bgr: the file's channels are blue, green, red.
        upside_down: the file's first row is the bottom of the picture. DiffuserCam's ``.npy`` files need both.
        upright: rotate a photograph according to its EXIF orientation; frames of a sensor are never rotated.

    Returns:
        (H, W, 1) or (H, W, 3), RGB, row 0 at the top, uint8 or uint16 as stored, any float as float32.
        Grey has one channel, opaque alpha is dropped, leading axes of length 1 are removed.

    Raises:
        ImageError: no such regular file; damaged, cut off, or of an unknown format; a stack of pictures; other numbers
            or axes than these; more than `mwdn.io.arrays.MAX_PIXELS` pixels or `mwdn.io.headers.MAX_DECODED_BYTES`, or
            far more than the file can hold; NaN or infinity. Damage is found by checksums, lengths and libjpeg's
            warnings: changed numbers of a BMP, PGM, PPM, NPY, WebP or uncompressed TIFF cannot be told from a capture.
    """
    frame = read(Path(path), photograph=upright)
    return np.ascontiguousarray(frame[:: -1 if upside_down else 1, :, :: -1 if bgr else 1])


def decode_frame(data: bytes, name: str) -> Frame:
    """Read a frame from the bytes of a file, its numbers exactly as stored.

    Args:
        data: whole content of a PNG, JPEG or BMP.
        name: of the data, for the error message.

    Returns:
        (H, W, 1) or (H, W, 3), as for `read_frame`.

    Raises:
        ImageError: damaged, cut off, or of another format.
    """
    try:
        kind = kind_of(data)
        if kind not in ("PNG", "JPEG", "BMP"):
            raise ImageError(f"must be PNG, JPEG or BMP, but starts with {data[:8]!r}. Export it as PNG.")
        return np.ascontiguousarray(decode(kind, data, photograph=False))
    except ImageError as error:
        raise ImageError(f"{name} {error}") from error


@checked
def read_picture(path: str | Path) -> Image:
    """Read a photograph as linear light: rotated according to its EXIF orientation, decoded from sRGB.

    Args:
        path: PNG, JPEG, WebP, BMP, PGM, PPM, TIFF (one picture) or NPY, of 8 or 16 bits.

    Returns:
        (1, 3, H, W), in [0, 1]; 1 is the largest number of 8 or 16 bits. Grey is repeated, alpha dropped.

    Raises:
        ImageError: as for `read_frame`, or the file holds floats, which have no standard gamma.
    """
    pixels = read(Path(path), photograph=True)
    if pixels.dtype.kind == "f":
        raise ImageError(f"`{path}` holds floats; a photograph has 8 or 16 bits. Read it with `read_frame`.")
    peak = np.iinfo(pixels.dtype).max
    light = srgb_decode(torch.arange(peak + 1) / peak).numpy()[pixels]  # a table: one power per level, not per pixel
    return torch.from_numpy(light).movedim(-1, 0)[None].expand(-1, 3, -1, -1).contiguous()


@checked
def write_picture(path: str | Path, image: Tensor | FloatFrame, *, bits: int = 8) -> None:
    """Write a picture for display as PNG, atomically: clipped to [0, 1], encoded as sRGB, rounded.

    Args:
        path: ends in ``.png``; missing folders are created.
        image: tensor (1, C, H, W) or (C, H, W), or numpy array (H, W) or (H, W, C), with 1 or 3 channels, RGB, row 0 at
            the top. Floats in linear light, 1 is white; integers are refused, because they may be encoded already.
        bits: 8, or 16 for a picture that will be edited.

    Raises:
        ParameterError: ``bits`` is neither.
        ImageError: another suffix or shape, integers, NaN or infinity, most numbers above 1, or the file cannot be
            written.
    """
    if bits not in (8, 16):
        raise ParameterError(f"`bits` ({bits}) must be 8 or 16, the depths of a PNG in colour.")
    frame = _float_frame(Path(path), image, ".png")
    if np.median(frame) > 1:
        raise ImageError(
            f"`image` (up to {frame.max():g}) must be linear light, 1 for white, but is above 1 in most pixels. Scale "
            "it first: `mwdn.to_display(image)`."
        )
    encoded = srgb_encode(torch.from_numpy(frame)).mul(2**bits - 1).round().numpy()
    write_frame(path, encoded.astype(f"uint{bits}"))


@checked
def write_linear(path: str | Path, image: Tensor | FloatFrame) -> None:
    """Write the exact float32 numbers of an image, atomically; `read_frame` returns them.

    Args:
        path: ends in ``.tif``, ``.tiff`` or ``.npy``; missing folders are created.
        image: tensor (1, C, H, W) or (C, H, W), or numpy array (H, W) or (H, W, C), with 1 or 3 channels; floats of any
            range.

    Raises:
        ImageError: another suffix or shape, integers, NaN or infinity, or the file cannot be written.
    """
    write_frame(path, _float_frame(Path(path), image, ".npy", ".tif", ".tiff"))


@checked
def write_imagej(path: str | Path, image: Tensor | FloatFrame, *, pixel_um: float | None = None) -> None:
    """Write the exact float32 numbers of an image as a TIFF that ImageJ opens, atomically; `read_frame` returns them.

    ImageJ cannot open colours of 32 bits in one plane, as `write_linear` stores them, so each is a channel of its own,
    shown as a composite. All have one display range, from 0 to the brightest 0.3 %; the numbers stay as they are.

    Args:
        path: ends in ``.tif`` or ``.tiff``; missing folders are created.
        image: as for `write_linear`.
        pixel_um: distance between pixels in micrometres, ImageJ's scale; without it, ImageJ counts pixels.

    Raises:
        ParameterError: ``pixel_um`` is not from 1e-9 to 1e9, the fractions that a TIFF can hold.
        ImageError: as for `write_linear`.
    """
    import tifffile

    if pixel_um is not None and not 1e-9 <= pixel_um <= 1e9:
        raise ParameterError(f"`pixel_um` ({pixel_um}) must be from 1e-9 to 1e9: micrometres between pixels.")
    frame = _float_frame(Path(path), image, ".tif", ".tiff")
    brightest = float(np.quantile(frame, 0.997))
    white = brightest if brightest > 0 else 1.0
    axes = "TZCYXS"  # all six: tifffile would take a frame of one column for one without columns
    about: dict[str, object] = {"axes": axes, "mode": "composite", "Ranges": (0.0, white) * frame.shape[-1]}
    if frame.shape[-1] == 1:
        about = {"axes": axes, "min": 0.0, "max": white}
    resolution = None if pixel_um is None else (1 / pixel_um, 1 / pixel_um)
    if resolution is not None:
        about["unit"] = "um"
    with atomic_write(path) as temporary:
        planes = np.moveaxis(frame, -1, 0)[None, None, ..., None]
        tifffile.imwrite(temporary, planes, imagej=True, metadata=about, resolution=resolution)


def write_frame(path: str | Path, frame: Frame) -> None:
    """Write a frame, its numbers exactly as they are, atomically; `read_frame` returns them.

    Args:
        path: PNG for uint8 or uint16; NPY, or by any other suffix TIFF, for floats, too.
        frame: (H, W), (H, W, 1) or (H, W, 3), RGB; other floats become float32.

    Raises:
        ImageError: it is no frame, see `as_frame`; the file cannot be written; or a PNG has floats, or over a million
            rows or columns.
    """
    path, frame = Path(path), as_frame(frame)
    suffix = path.suffix.lower()
    data = encode_png(frame, path) if suffix == ".png" else b""  # before there is a temporary file
    with atomic_write(path) as temporary:
        if suffix == ".png":
            temporary.write_bytes(data)
        elif suffix == ".npy":
            with temporary.open("wb") as file:
                np.save(file, frame, allow_pickle=False)
        else:
            import tifffile

            tifffile.imwrite(temporary, frame, photometric="rgb" if frame.shape[-1] == 3 else "minisblack")


def encode_png(frame: Frame, name: str | Path) -> bytes:
    """A frame as a PNG of 8 or 16 bits: the content of the file that `write_frame` writes.

    Args:
        frame: (H, W), (H, W, 1) or (H, W, 3), RGB, uint8 or uint16.
        name: of the picture, for the error.

    Raises:
        ImageError: it is no frame, has floats, or over a million rows or columns.
    """
    import cv2

    frame = as_frame(frame)  # else the columns of (H, W) would be mirrored below
    if frame.dtype.kind == "f":  # OpenCV would round them to 8 bits
        raise ImageError(f"`{name}` cannot be written: PNG holds uint8 or uint16, not floats. Write a .tif or .npy.")
    try:
        encoded, data = cv2.imencode(".png", np.ascontiguousarray(frame[..., ::-1]))
    except cv2.error as error:
        raise ImageError(f"`{name}` cannot be written: OpenCV: {error.err}.") from error
    if not encoded:
        raise ImageError(
            f"`{name}` cannot be written: OpenCV cannot encode {frame.shape[0]:,} x {frame.shape[1]:,} pixels as PNG."
        )
    return data.tobytes()


def srgb_encode(linear: Tensor) -> Tensor:
    """Encode linear light, of any shape and clipped to [0, 1], as sRGB.

    References:
        IEC 61966-2-1:1999, section 5.2: linear up to 0.0031308, then a power of 1 / 2.4. 0.2140 becomes 0.5.
    """
    linear = linear.clamp(0, 1)
    power = linear ** (1 / 2.4)
    # 1.055 power - 0.055, in a form that makes white exactly 1 in float32 too.
    return torch.where(linear <= 0.0031308, 12.92 * linear, power + 0.055 * (power - 1))


def srgb_decode(encoded: Tensor) -> Tensor:
    """Decode sRGB numbers in [0, 1], of any shape, to linear light; the inverse of `srgb_encode`."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _float_frame(path: Path, image: Tensor | FloatFrame, *suffixes: str) -> FloatFrame:
    """(H, W, C) float32 numbers of an image, after checks of its shape and of the suffix of ``path``."""
    if path.suffix.lower() not in suffixes:
        raise ImageError(f"`{path}` must end in {' or '.join(suffixes)}, not '{path.suffix}'. Rename it.")
    got = f"{' x '.join(map(str, image.shape))}, {image.dtype}" if hasattr(image, "shape") else type(image).__name__
    if not isinstance(image, Tensor):
        image = torch.from_numpy(as_frame(image).copy()).movedim(-1, 0)  # flipped and read-only arrays, too
    picture = image[0] if image.ndim == 4 and len(image) == 1 else image
    fits = picture.ndim == 3 and len(picture) in (1, 3) and picture.numel() > 0
    if not (fits and picture.is_floating_point()):
        wanted = "a tensor (C, H, W) or (1, C, H, W) or an array (H, W, C), floats of 1 or 3 channels"
        raise ImageError(
            f"`image` ({got}) must be {wanted} for `{path}`: linear light, 1 is white. Pick one of a batch; divide "
            "integers by their maximum, and decode sRGB by `mwdn.io.images.srgb_decode`."
        )
    picture = picture.detach().to("cpu", torch.float32)
    if not torch.isfinite(picture).all():
        raise ImageError(f"`image` holds NaN or infinity: `{path}` is not written. Use `torch.nan_to_num`.")
    return picture.movedim(0, -1).contiguous().numpy()
