"""How to turn the numbers of a raw frame into a measurement."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from mwdn.errors import ParameterError, ShapeError, UnknownNameError
from mwdn.io.images import read_frame
from mwdn.types import Frame, Image, Measurement, Size

Mosaic = Literal["rggb", "bggr", "grbg", "gbrg"]
"""Colour filter arrays: the colours of a 2 x 2 cell, row by row."""


@dataclass(frozen=True, kw_only=True)
class FrameFormat:
    """What the numbers in a raw frame mean. The fields are in the order of the steps: `read`, then `to_measurement`.

    Args:
        bgr: the file's channels are blue, green, red (DiffuserCam's .npy).
        bit_depth: bits of the sensor, if its numbers do not fill the file's type.
        mosaic: raw frames of a colour filter array with this order: each 2 x 2 cell becomes one pixel.
        grey: average the colours.
        crop: height and width of the central part to use, in raw pixels; with a mosaic, in 2 x 2 cells.
        bin: average blocks of this many pixels along each axis, after the crop.
        upside_down: the file's first row is the bottom of the picture (DiffuserCam's .npy).

    Raises:
        ParameterError: ``bit_depth`` is not 1 to 16, or ``bin`` is less than 1.
        UnknownNameError: no such mosaic.
    """

    bgr: bool = False
    bit_depth: int | None = None
    mosaic: Mosaic | None = None
    grey: bool = False
    crop: Size | None = None
    bin: int = 1
    upside_down: bool = False

    def __post_init__(self) -> None:
        if self.bit_depth is not None and not 1 <= self.bit_depth <= 16:
            raise ParameterError(f"`bit_depth` ({self.bit_depth}) must be 1 to 16.")
        if self.mosaic is not None and self.mosaic not in get_args(Mosaic):
            raise UnknownNameError("mosaic", self.mosaic, get_args(Mosaic))
        if self.bin < 1:
            raise ParameterError(f"`bin` ({self.bin}) must be at least 1.")

    def read(self, path: str | Path) -> Frame:
        """Read a raw frame as (H, W, C), its numbers as stored and its channels in the order RGB.

        Raises:
            ImageError: the file cannot be read.
        """
        return read_frame(path, bgr=self.bgr)

    def to_measurement(self, frame: Frame, dark: Tensor | None = None) -> Measurement:
        """Turn a raw frame into a measurement.

        Args:
            frame: (H, W, C), from `read`.
            dark: frame taken without light, from `normalise`.

        Returns:
            (1, C, height, width), linear light, row 0 at the top; 1 is saturation.

        Raises:
            ParameterError: a pixel value exceeds the bit depth, or the frame is smaller than ``bin``.
            ShapeError: the dark frame, the crop or the mosaic does not fit the frame.
        """
        image = self.normalise(frame)
        if dark is not None:
            image = subtract_dark(image, dark)
        if self.mosaic is not None:
            image = demosaic(image, self.mosaic)
        if self.grey:
            image = image.mean(1, keepdim=True)
        if self.crop is not None:
            image = crop_centre(image, self.crop)
        image = bin_pixels(image, self.bin)
        return image.flip(-2) if self.upside_down else image

    def normalise(self, frame: Frame) -> Image:
        """Divide a frame (H, W, C) by its full scale: (1, C, H, W), 1 is saturation."""
        return torch.from_numpy(frame.astype(np.float32)).movedim(-1, 0)[None].contiguous() / self.full_scale(frame)

    def full_scale(self, frame: Frame) -> float:
        """Largest number of the sensor: ``2^bit_depth - 1``; without a bit depth the file type's maximum, 1 for floats.

        Raises:
            ParameterError: the frame holds a larger number, or the file's type has fewer bits.
        """
        if self.bit_depth is None:
            return 1.0 if frame.dtype.kind == "f" else float(np.iinfo(frame.dtype).max)
        if frame.dtype.kind != "f" and self.bit_depth > 8 * frame.dtype.itemsize:
            raise ParameterError(
                f"`bit_depth` ({self.bit_depth}) must be at most {8 * frame.dtype.itemsize}, the bits of the file's "
                "numbers. Save frames with 16 bits, or leave out `--bit-depth`."
            )
        maximum = 2**self.bit_depth - 1
        if frame.max() > maximum:
            raise ParameterError(
                f"`bit_depth` ({self.bit_depth}) allows numbers up to {maximum:,}, but the frame holds "
                f"{frame.max():,}: it has at least {int(frame.max()).bit_length()} bits. Leave out `--bit-depth` if "
                "the numbers fill the file's type."
            )
        return float(maximum)

    def saturated(self, frame: Frame) -> tuple[int, int]:
        """Number of saturated pixels, and the number at which the sensor saturates; (0, 1) for floats."""
        if frame.dtype.kind == "f":
            return 0, 1
        maximum, largest = int(self.full_scale(frame)), int(frame.max())
        # Sensors that store 12 bits in the upper bits of 16 saturate at 65,520. Others store 10, 12 or 14 bits in the
        # lower bits, and the bit depth may not have been given. In both cases the frame's largest number counts.
        in_lower_bits = self.bit_depth is None and maximum > 255 and largest in (1023, 4095, 16383)
        if in_lower_bits or largest > 0.98 * maximum:
            maximum = largest
        return int((frame.max(axis=-1) >= maximum).sum()), maximum

    def with_bin(self, bin: int) -> "FrameFormat":
        """The format of frames of the same view at another resolution: ``crop`` is scaled with ``bin``."""
        crop = self.crop and (self.crop[0] * bin // self.bin, self.crop[1] * bin // self.bin)
        return replace(self, bin=bin, crop=crop)


def subtract_dark(image: Image, dark: Tensor) -> Image:
    """Subtract a dark frame (1, C or 1, H, W).

    Raises:
        ShapeError: it has another size.
    """
    if dark.shape[-2:] != image.shape[-2:] or dark.shape[1] not in (1, image.shape[1]):
        raise ShapeError(
            f"`dark` {tuple(dark.shape[1:])} must have the size of the frame {tuple(image.shape[1:])}. "
            "Take it with the same camera settings."
        )
    return image - dark


def demosaic(image: Tensor, mosaic: Mosaic) -> Tensor:
    """Turn each 2 x 2 cell of a colour filter array into one pixel; its two greens are averaged.

    The colours of a cell are not interpolated to a common position. Their offsets are the same in the PSF and in the
    captures, so reconstructions have no colour fringes.

    Args:
        image: (B, 1, H, W), H and W even.
        mosaic: colours of the cell's first row, then of its second row.

    Returns:
        (B, 3, H / 2, W / 2), red, green, blue.

    Raises:
        ShapeError: more than one channel, or an odd height or width.
    """
    channels, height, width = image.shape[1:]
    if channels != 1 or height % 2 or width % 2:
        raise ShapeError(f"A raw mosaic ({channels} x {height} x {width}) must have one channel and even sides.")
    samples = [image[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]
    colours = [[sample for sample, letter in zip(samples, mosaic, strict=True) if letter == c] for c in "rgb"]
    return torch.cat([sum(same[1:], same[0]) / len(same) for same in colours], dim=1)


def crop_centre(image: Tensor, size: Size) -> Tensor:
    """Crop to the central ``size``; the centre ``(H // 2, W // 2)`` stays the centre.

    Raises:
        ShapeError: the image is smaller.
    """
    height, width = image.shape[-2:]
    if size[0] > height or size[1] > width or min(size) < 1:
        raise ShapeError(f"`crop` ({size[0]} x {size[1]}) must be within the frame ({height} x {width}).")
    top, left = height // 2 - size[0] // 2, width // 2 - size[1] // 2
    return image[..., top : top + size[0], left : left + size[1]]


def bin_pixels(image: Tensor, factor: int) -> Tensor:
    """Average blocks of ``factor`` x ``factor`` pixels; the block that holds the centre becomes the centre.

    Raises:
        ParameterError: the factor is not positive, or larger than the image.
    """
    if not 1 <= factor <= min(image.shape[-2:]):
        raise ParameterError(f"`bin` ({factor}) must be at least 1 and at most {min(image.shape[-2:])}.")
    if factor == 1:
        return image
    # Leftover rows and columns are cut on both sides such that pixel n // 2 falls into block (n // factor) // 2.
    blocks = [n // factor for n in image.shape[-2:]]
    start = [
        min(max(n // 2 - (m // 2) * factor, 0), n - m * factor) for n, m in zip(image.shape[-2:], blocks, strict=True)
    ]
    image = image[..., start[0] : start[0] + blocks[0] * factor, start[1] : start[1] + blocks[1] * factor]
    return torch.nn.functional.avg_pool2d(image, factor)
