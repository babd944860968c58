"""The calibration of a camera: its PSF, and how its raw frames become measurements."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from mwdn.calibration.frames import (
    Background,
    Mosaic,
    as_image,
    bin_pixels,
    crop_centre,
    demosaiced,
    estimate_background,
    full_scale,
)
from mwdn.errors import ParameterError, PsfError, ShapeError
from mwdn.io.images import read_frame
from mwdn.optics.psf import psf_hash
from mwdn.types import Frame, Measurement, Psf, Size

SATURATED_PART = 1e-3
"""A PSF whose lines saturate is a wrong PSF; a few hot pixels are not. 1e-3 of 320 x 320 are 102 pixels."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A PSF and what is known about the camera that it belongs to.

    Args:
        psf: (1, C, H, W), not negative, each channel of unit sum, centred at ``(H // 2, W // 2)``.
        bit_depth: of raw frames; ``None`` if their numbers fill the file's type, or are floats up to 1.
        dark: frame (1, C or 1, h, w) taken without light, as a part of the full scale, before crop and binning.
        crop: middle part of raw frames that is used, in raw pixels; of a mosaic in pixels of 2 x 2 cells.
        binning: pixels that were averaged to one after that, along each axis.
        background: level that was subtracted from each channel of the PSF, as a part of the full scale.
        upside_down: raw frames have their first row at the bottom.
        bgr: raw frames have their channels in the order blue, green, red.
        pitch_um: distance of the pixels after binning.
        distance_mm: from the point source to the camera.
        mosaic: raw frames are a colour filter array, see `mwdn.calibration.frames.demosaiced`.
        grey: colours of raw frames are averaged.
    """

    psf: Psf
    bit_depth: int | None = None
    dark: Tensor | None = None
    crop: Size | None = None
    binning: int = 1
    background: tuple[float, ...] = ()
    upside_down: bool = False
    bgr: bool = False
    pitch_um: float | None = None
    distance_mm: float | None = None
    mosaic: Mosaic | None = None
    grey: bool = False

    @classmethod
    def from_file(  # noqa: PLR0913
        cls,
        path: str | Path,
        *,
        dark: str | Path | None = None,
        background: Background = "estimate",
        bit_depth: int | None = None,
        crop: Size | None = None,
        binning: int = 1,
        psf_binning: int | None = None,
        upside_down: bool = False,
        bgr: bool = False,
        mosaic: Mosaic | None = None,
        grey: bool = False,
    ) -> "Calibration":
        """Read the picture of a point source.

        Args:
            path: PNG, TIFF or NPY of 8 to 16 bits or floats, grey or colour, linear in light.
            dark: a frame taken with the same exposure and no light; subtracted from the PSF and from captures.
            background: even light under the PSF besides the dark frame: a part of the full scale, or
                ``"estimate"`` (see `mwdn.calibration.frames.estimate_background`). 0 for a PSF already clean.
            bit_depth: of the sensor, where its numbers do not fill the file's type.
            crop: height and width of the middle part to use, in raw pixels; of a mosaic in pixels of 2 x 2 cells.
            binning: average blocks of so many pixels along each axis, after the crop.
            psf_binning: that of the PSF, where it was taken at another resolution than the captures, whose crop then
                covers the same part of it, and whose dark frame is left out of it.
            upside_down: the file's first row is the picture's last.
            bgr: the file's channels are blue, green, red.
            mosaic: PSF, dark frame and captures are raw frames of a colour filter array, of which this is the order.
            grey: average the colours of all of them.

        Raises:
            ImageError: the file cannot be read.
            PsfError: the PSF is saturated, empty, or of the wrong channel count.
            ShapeError: the dark frame does not fit, or a mosaic has colours or odd sides.
            ParameterError: a number is outside its range.
        """
        frame = read_frame(path, bgr=bgr)
        _refuse_saturated(frame, bit_depth)
        dark_image = None
        if dark is not None:
            dark_frame = read_frame(dark, bgr=bgr)
            dark_image = as_image(dark_frame, full_scale(dark_frame, bit_depth))
        if binning < 1:
            raise ParameterError(f"`binning` ({binning}) must be at least 1.")
        own, part, its_dark = binning, crop, dark_image
        if psf_binning is not None and psf_binning != binning:
            own, its_dark = psf_binning, None
            part = crop and (crop[0] * own // binning, crop[1] * own // binning)
        psf = cls(torch.ones(1, 1, 1, 1), bit_depth, its_dark, part, own, mosaic=mosaic, grey=grey).prepare(frame)
        level = _level(psf, background)
        psf = (psf - level).clamp(min=0)
        total = psf.sum((-2, -1), keepdim=True)
        if not (total > 0).all():
            raise PsfError(_empty(path, total.flatten() > 0, level.flatten(), dark))
        return cls(
            _turn(psf / total) if upside_down else psf / total,
            bit_depth,
            dark_image,
            crop,
            binning,
            tuple(round(float(value), 6) for value in level.flatten()),
            upside_down,
            bgr,
            mosaic=mosaic,
            grey=grey,
        )

    def __post_init__(self) -> None:
        if self.psf.ndim != 4 or self.psf.shape[0] != 1 or self.psf.shape[1] not in (1, 3):
            raise PsfError(f"`psf` {tuple(self.psf.shape)} must be (1, 1 or 3, H, W): grey or RGB.")
        if not self.psf.isfinite().all():
            raise PsfError("`psf` holds NaN or infinity. Capture it again.")
        if self.psf.min() < 0 or not (self.psf.sum((-2, -1)) > 0).all():
            raise PsfError(
                f"`psf` (smallest value {self.psf.min():.3g}) must not be negative, and must hold light in each "
                "channel. Subtract its background and clip it: `psf.clamp(min=0)`."
            )

    @cached_property
    def psf_hash(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of the PSF's shape and float32 numbers."""
        return psf_hash(self.psf)

    @property
    def size(self) -> Size:
        """Height and width of the PSF and of a measurement."""
        return self.psf.shape[-2], self.psf.shape[-1]

    def saturated_part(self, frame: Frame) -> float:
        """Part of a raw frame's pixels that are at the sensor's maximum; 0 of floats, which tell of none."""
        return saturated(frame, self.bit_depth)[0] / (frame.shape[0] * frame.shape[1])

    def prepare(self, frame: Frame) -> Measurement:
        """Subtract the dark frame, make pixels of a mosaic's cells, crop and bin; rows stay in the file's order."""
        image = as_image(frame, full_scale(frame, self.bit_depth))
        if self.dark is not None:
            if self.dark.shape[-2:] != image.shape[-2:] or self.dark.shape[1] not in (1, image.shape[1]):
                raise ShapeError(
                    f"`dark` {tuple(self.dark.shape[1:])} must have the size of the frame {tuple(image.shape[1:])}. "
                    "Take it with the same camera settings."
                )
            image = image - self.dark
        image = demosaiced(image, self.mosaic) if self.mosaic else image
        image = image.mean(1, keepdim=True) if self.grey else image
        return bin_pixels(crop_centre(image, self.crop) if self.crop else image, self.binning)

    def correct(self, frame: Frame) -> Measurement:
        """Turn a raw frame into a measurement: levels, crop, binning, orientation.

        Args:
            frame: (H, W, C) numbers of the sensor, RGB, as `mwdn.io.images.read_frame` gives them.

        Returns:
            (1, C, *size), linear light; 1 is saturation.

        Raises:
            ShapeError: the frame does not fit the PSF.
            ParameterError: a number of the frame exceeds the bit depth.
        """
        measurement = self.prepare(frame)
        if measurement.shape[-2:] != self.psf.shape[-2:]:
            (h, w), (H, W) = measurement.shape[-2:], self.size
            raise ShapeError(
                f"`psf` ({H} x {W}) and the capture ({h} x {w}) must have the same height and width. "
                + _way_out((h, w), (H, W), self.binning)
            )
        channels = measurement.shape[1]
        if channels == 1 and self.psf.shape[1] == 3:
            raise ShapeError(
                "The capture is grey, but `psf` has colours. Take both as grey, `--grey`; or say how the cells of raw "
                "frames are coloured, `--mosaic rggb`."
            )
        # No `_turn`: a capture has no centre to keep, and a rolled row would be one of the opposite border.
        return measurement.flip(-2) if self.upside_down else measurement


def _empty(path: str | Path, lit: Tensor, level: Tensor, dark: str | Path | None) -> str:
    names = ["grey"] if len(lit) == 1 else ["red", "green", "blue"]
    without = [name for name, light in zip(names, lit.tolist(), strict=True) if not light]
    ways = ["Expose longer"]
    ways += [f"take the dark frame `{dark}` without light"] if dark else []
    ways += ["give `--background 0`"] if level.max() > 0 else []
    return (
        f"PSF `{path}` is empty: after the background ({', '.join(f'{v:.3g}' for v in level)} of the full scale; "
        f"nothing of {', '.join(without)}) no light is left in a channel. {', or '.join(ways)}."
    )


def _turn(image: Tensor) -> Tensor:
    """Put a PSF's last row first and keep its centre ``H // 2``: an even height needs one row's roll."""
    turned = image.flip(-2)
    return turned.roll(1, -2) if image.shape[-2] % 2 == 0 else turned


def saturated(frame: Frame, bit_depth: int | None) -> tuple[int, int]:
    """How many pixels of a raw frame of integers are at its sensor's maximum, and that maximum; 0 pixels of floats."""
    if frame.dtype.kind == "f":
        return 0, 1
    top = int(full_scale(frame, bit_depth))
    # Sensors that store 12 bits as the upper ones of 16 saturate at 65,520: the largest number found counts.
    # So it does where 10, 12 or 14 bits lie in the lower ones and nobody said so.
    unsaid = bit_depth is None and top > 255 and frame.max() in (1023, 4095, 16383)
    top = int(frame.max()) if unsaid or frame.max() > 0.98 * top else top
    return int((frame.max(axis=-1) >= top).sum()), top


def _refuse_saturated(frame: Frame, bit_depth: int | None) -> None:
    full, top = saturated(frame, bit_depth)
    pixels = frame.shape[0] * frame.shape[1]
    if full > SATURATED_PART * pixels:
        raise PsfError(
            f"PSF is saturated: {full:,} of {pixels:,} pixels are at the {top.bit_length()}-bit maximum "
            f"{top}. Lower the exposure and capture it again."
        )


def _level(psf: Tensor, background: Background) -> Tensor:
    if background == "estimate":
        return estimate_background(psf).clamp(min=0)  # below 0 where somebody has subtracted it before
    if not 0 <= background < 1:
        raise ParameterError(f"`background` ({background}) must be in [0, 1), a part of the full scale.")
    return torch.full((1, psf.shape[1], 1, 1), float(background))


def _way_out(capture: Size, psf: Size, binning: int) -> str:
    for (a, b), name, options in (
        ((psf, capture), "PSF", "--psf-bin {more}"),
        ((capture, psf), "capture", "--bin {more} --psf-bin {binning}"),
    ):
        factor = a[0] // b[0]
        if factor > 1 and a == (b[0] * factor, b[1] * factor):
            options = options.format(more=binning * factor, binning=binning)
            return f"The {name} is {factor} times as large: bin it by {factor}, `{options}`."
    if psf[0] <= capture[0] and psf[1] <= capture[1]:
        return f"Crop the capture around its centre: `--crop {psf[0] * binning} {psf[1] * binning}`."
    return "Use the PSF that belongs to this camera."
