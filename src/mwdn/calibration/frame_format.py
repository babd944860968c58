"""How to turn the numbers of a raw frame into a measurement."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor

from mwdn.arguments import check_at_least, checked
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.float_scale import check_float_scale
from mwdn.calibration.frame_operations import bin_pixels, crop_centre, demosaic, subtract_dark
from mwdn.errors import ParameterError
from mwdn.io.arrays import as_frame
from mwdn.io.images import read_frame, srgb_decode, srgb_encode
from mwdn.io.raw import Mosaic, is_raw, read_raw
from mwdn.optics.saturation import keep_plateau
from mwdn.types import Frame, Image, Measurement, Size

Gamma = Literal["srgb"] | float
"""Encoding of a file: sRGB, or light raised to the power of 1 / gamma, where 1 is linear."""

MAX_GAMMA = 4.0
"""Cameras and displays use 1.8 to 2.6."""


@checked
@dataclass(frozen=True, kw_only=True)
class FrameFormat:
    """What the numbers in a raw frame mean. The fields are in the order of the steps: `read`, then `to_measurement`.

    Args:
        bgr: the file's channels are blue, green, red (DiffuserCam's .npy).
        bit_depth: bits of the sensor, if its numbers do not fill the file's type.
        gamma: encoding of the files, decoded to linear light: ``"srgb"`` for a camera's JPEG or another picture for
            viewing, or a power such as 2.2; without it numbers are linear in light, as in raw frames. The PSF's
            file has its own: ``psf_gamma``.
        crop: height and width of the central part to use, in raw pixels of the frame; even with a mosaic.
        mosaic: raw frames of a colour filter array with this order: each 2 x 2 cell becomes one pixel. A camera's raw
            file (.dng, .nef ...) says its own order, and that of the PSF's file holds for the captures.
        grey: average the colours.
        bin: average blocks of this many pixels along each axis.
        upside_down: the file's first row is the bottom of the picture (DiffuserCam's .npy).

    Raises:
        ParameterError: ``bit_depth`` is not 1 to 16, ``gamma`` not 1 to 4, ``bin`` less than 1, ``crop`` odd with a
            mosaic, or a field is of another type.
        UnknownNameError: no such mosaic.
    """

    bgr: bool = False
    bit_depth: int | None = None
    gamma: Gamma | None = None
    crop: Size | None = None
    mosaic: Mosaic | None = None
    grey: bool = False
    bin: int = 1
    upside_down: bool = False

    def __post_init__(self) -> None:
        if self.bit_depth is not None and not 1 <= self.bit_depth <= 16:
            raise ParameterError(f"`bit_depth` ({self.bit_depth}) must be 1 to 16.")
        check_gamma("gamma", self.gamma)
        check_at_least(1, bin=self.bin)
        if self.crop is not None and any(length % self.cell for length in self.crop):
            height, width = self.crop
            raise ParameterError(
                f"`crop` ({height} x {width}) must be even with a mosaic, whose cells are 2 x 2 pixels: "
                f"`crop=({height // 2 * 2}, {width // 2 * 2})`."
            )

    def __repr__(self) -> str:
        return f"FrameFormat({', '.join(f'{name}={value!r}' for name, value in changed_fields(self).items())})"

    @property
    def encoding(self) -> "FrameFormat":
        """Bit depth and gamma alone."""
        return FrameFormat(bit_depth=self.bit_depth, gamma=self.gamma)

    @property
    def cell(self) -> int:
        """Raw pixels of the frame, along each axis, that make one pixel before binning: 2 with a mosaic, else 1."""
        return 1 if self.mosaic is None else 2

    def read(self, path: str | Path) -> Frame:
        """Read a raw frame as (H, W, C), its numbers as stored and its channels in the order RGB.

        A camera's raw file becomes uint16, from 0 at its black level to 65,535 at its white level; each 2 x 2 cell of
        its mosaic becomes one RGB pixel, unless ``mosaic`` is given.

        Raises:
            ImageError: the file cannot be read.
            ParameterError: a raw file has another mosaic than ``mosaic``; or ``crop`` without ``mosaic``, and a raw
                file with one: its pixels are cells now.
        """
        frame, frames = self.read_stored(path)
        if frames.mosaic is None or frames.mosaic == self.mosaic:
            return frame
        if self.crop is not None:
            raise ParameterError(
                f"`crop` ({self.crop[0]} x {self.crop[1]}) counts raw pixels, but `{path}` is read as one pixel per "
                f"cell of its mosaic ({frames.mosaic}), for a PSF that is no raw file. Use the PSF's raw file, or crop "
                "the PSF's file and leave out `crop`."
            )
        return _cells(frame, frames.mosaic)

    def read_stored(self, path: str | Path) -> tuple[Frame, "FrameFormat"]:
        """Read a raw frame as `read`, but with its mosaic; and this format with the mosaic that a raw file says.

        Raises:
            ImageError: the file cannot be read.
            ParameterError: a raw file has another mosaic than ``mosaic``.
        """
        if is_raw(path):
            raw = read_raw(path)
            return raw.frame, self.with_mosaic(raw.mosaic, of=f"`{path}`")
        return read_frame(path, bgr=self.bgr), self

    def completed(
        self, bit_depth: str | int | float | None, mosaic: str | int | float | None, *, of: str
    ) -> "FrameFormat":
        """The format with what frames state themselves: their bit depth, unless it is given, and their mosaic.

        Args:
            bit_depth: of the frames, as an attribute of a file or a camera states it; ``None`` if it does not.
            mosaic: the same; empty for none.
            of: as for `with_mosaic`, which raises.
        """
        frames = self.with_mosaic(cast("Mosaic | None", mosaic or None), of=of)
        return frames if frames.bit_depth or not bit_depth else replace(frames, bit_depth=int(bit_depth))

    def with_mosaic(self, stated: Mosaic | None, *, of: str) -> "FrameFormat":
        """The format with the mosaic that frames state themselves.

        The order of a sensor changes if it is flipped, or if its window starts at an odd pixel. Then its frames are
        mirrored or displaced, too: PSF and dark frame do not fit them, whichever order is taken.

        Args:
            stated: by a raw file, a session or a camera; ``None`` if it states none.
            of: what states it, for the error message.

        Raises:
            ParameterError: ``mosaic`` is another one.
        """
        if stated is None or stated == self.mosaic:
            return self
        if self.mosaic is None:
            return replace(self, mosaic=stated)
        raise ParameterError(
            f"`mosaic` ({self.mosaic}) must be that of {of}, which states {stated}. If it is the PSF's, the sensor has "
            "been flipped or its window moved: take PSF and captures with the same settings. If you gave it: leave out "
            "`mosaic`."
        )

    def to_measurement(
        self, frame: Frame, dark: Tensor | None = None, corrections: Callable[[Image, int], Image] = Corrections()
    ) -> Measurement:
        """Turn a raw frame into a measurement.

        Args:
            frame: (H, W, C), from `read`.
            dark: frame to subtract, from `normalise`: taken without light, or with the room's light alone.
            corrections: flat field and hot pixels, in raw pixels (1, C, H, W): `Corrections`, or its `of_capture`.

        Returns:
            (1, C, height, width), linear light, row 0 at the top; 1 is saturation. Saturated pixels are a plateau.

        Raises:
            ParameterError: a pixel value exceeds the bit depth, or the frame is smaller than ``bin``.
            ShapeError: the dark frame, the crop or the mosaic does not fit the frame.
        """
        image = self.normalise(frame)
        if dark is not None:
            rest = subtract_dark(image, dark)
            image = keep_plateau(image, rest) if self.saturated(frame)[0] else rest
        image = corrections(image, self.cell)
        if self.crop is not None:
            image = crop_centre(image, self.crop, self.cell)
        if self.mosaic is not None:
            image = demosaic(image, self.mosaic)
        if self.grey:
            image = image.mean(1, keepdim=True)
        image = bin_pixels(image, self.bin)
        return image.flip(-2) if self.upside_down else image

    def normalise(self, frame: Frame) -> Image:
        """Divide a frame (H, W, C) by its full scale and decode its gamma: (1, C, H, W), 1 is saturation."""
        frame = as_frame(frame, finite=False)
        image = torch.from_numpy(frame.astype(np.float32)).movedim(-1, 0)[None].contiguous() / self.full_scale(frame)
        if self.gamma is None:
            return image
        return srgb_decode(image) if self.gamma == "srgb" else image.clamp(min=0) ** self.gamma

    def offset(self, frame: Frame | None, name: str) -> Image | None:
        """`normalise` for a frame that is subtracted from others.

        Raises:
            ParameterError: see `check_bits`; or it holds floats on another scale than [0, 1], without a bit depth.
        """
        if frame is None:
            return None
        check_float_scale(frame, self.bit_depth, of=f"`{name}`")
        self.check_bits(frame, f"`{name}`")
        return self.normalise(frame)

    def denormalise(self, image: Image) -> Frame:
        """Inverse of `read` and `normalise`: a frame of floats (H, W, C) in the order of the camera's files."""
        if self.gamma is not None:
            light = image.clamp(min=0)
            image = srgb_encode(light) if self.gamma == "srgb" else light ** (1 / self.gamma)
        pixels = image[0].movedim(0, -1) * (1 if self.bit_depth is None else 2**self.bit_depth - 1)
        return (pixels.flip(-1) if self.bgr else pixels).contiguous().numpy().astype(np.float32)

    def full_scale(self, frame: Frame) -> float:
        """Largest number of the sensor: ``2^bit_depth - 1``; without a bit depth the file type's maximum, 1 for floats.

        Raises:
            ParameterError: see `check_bits`.
        """
        frame = as_frame(frame, finite=False)
        self.check_bits(frame)
        if self.bit_depth is None:
            return 1.0 if frame.dtype.kind == "f" else float(np.iinfo(frame.dtype).max)
        return float(2**self.bit_depth - 1)

    def check_bits(self, frame: Frame, of: str = "the frame") -> None:
        """Raise a `ParameterError` if a frame's type has fewer bits than ``bit_depth``, or its numbers have more.

        Args:
            frame: (H, W, C).
            of: what the frame is, for the message.
        """
        if self.bit_depth is None:
            return
        if frame.dtype.kind != "f" and self.bit_depth > 8 * frame.dtype.itemsize:
            raise ParameterError(
                f"`bit_depth` ({self.bit_depth}) must be at most {8 * frame.dtype.itemsize}, the bits of the numbers "
                f"of {of}. Save frames with 16 bits, or leave out `bit_depth`."
            )
        maximum = 2**self.bit_depth - 1
        if frame.max() > maximum:
            raise ParameterError(
                f"`bit_depth` ({self.bit_depth}) allows numbers up to {maximum:,}, but {of} holds {frame.max():,}: it "
                f"has at least {int(frame.max()).bit_length()} bits. Leave out `bit_depth` if the numbers fill the "
                "file's type."
            )

    def saturated(self, frame: Frame) -> tuple[int, int]:
        """Number of saturated pixels, and the number at which the sensor saturates; (0, 1) for floats."""
        frame = as_frame(frame, finite=False)
        if frame.dtype.kind == "f":
            return 0, 1
        maximum, largest = int(self.full_scale(frame)), int(frame.max())
        bits = self.possible_bit_depth(frame)
        # Sensors that store 12 bits in the upper bits of 16 saturate at 65,520. Others store them in the lower bits,
        # and the bit depth may not have been given. In both cases the frame's largest number counts.
        if largest > 0.98 * maximum or (bits and largest == 2**bits - 1):
            maximum = largest
        return int((frame.max(axis=-1) >= maximum).sum()), maximum

    def possible_bit_depth(self, frame: Frame) -> int | None:
        """Least of 10, 12 and 14 bits that hold a 16-bit frame, which may just be dark; ``None`` if they are given."""
        if self.bit_depth is not None or frame.dtype != np.uint16:
            return None
        return next((bits for bits in (10, 12, 14) if frame.max() < 2**bits), None)

    def full_size(self, frame: Frame) -> Size:
        """Height and width of a raw frame's measurement before binning."""
        height, width = self.crop or frame.shape[:2]
        return height // self.cell, width // self.cell

    def with_bin(self, bin: int) -> "FrameFormat":
        """The format of frames of the same view at another resolution: ``crop`` is scaled with ``bin``."""
        if self.crop is None:
            return replace(self, bin=bin)
        height, width = (length // self.cell * bin // self.bin * self.cell for length in self.crop)
        return replace(self, bin=bin, crop=(height, width))


def changed_fields(format: Any) -> dict[str, Any]:  # noqa: ANN401
    """The fields of a dataclass that differ from their defaults, by name."""
    values = ((field, getattr(format, field.name)) for field in fields(format))
    return {field.name: value for field, value in values if value != field.default}


def check_gamma(name: str, gamma: Gamma | None) -> None:
    """Raise a `ParameterError` unless the option called ``name`` is a gamma."""
    if gamma not in (None, "srgb") and not (isinstance(gamma, int | float) and 1 <= gamma <= MAX_GAMMA):
        raise ParameterError(f"`{name}` ({gamma}) must be 'srgb', or a number from 1 (linear) to {MAX_GAMMA:g}.")


def _cells(frame: Frame, mosaic: Mosaic) -> Frame:
    """One RGB pixel per cell of a raw file's mosaic."""
    image = torch.from_numpy(frame.astype(np.float32)).movedim(-1, 0)[None]
    colours = demosaic(image, mosaic)[0].movedim(0, -1)
    return colours.round().numpy().astype(np.uint16, order="C")
