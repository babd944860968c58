"""The calibration of a camera: its PSF, and the format of its raw frames."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from mwdn.calibration.frame_format import FrameFormat
from mwdn.errors import ParameterError, PsfError, ShapeError, check_options
from mwdn.io.formats import as_frame
from mwdn.optics.psf import psf_hash
from mwdn.types import ArrayPicture, Frame, Image, Measurement, Psf, Size

Background = float | Literal["estimate"]
"""A level as a fraction of the full scale, or ``"estimate"``."""

SATURATED_PART = 1e-3
"""Largest fraction of saturated pixels in a PSF: a few hot pixels do no harm, saturated lines do. 102 of 320 x 320."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A PSF, and how raw frames of its camera become measurements.

    Args:
        psf: (1, C, H, W), not negative, each channel of unit sum, centred at ``(H // 2, W // 2)``.
        frames: format of raw frames.
        dark: (1, C or 1, h, w), raw frame taken without light, as a fraction of the full scale.
        background: level that was subtracted from each channel of the PSF, as a fraction of the full scale.
        pitch_um: distance between pixels after binning.
        distance_mm: distance from the point source to the camera.
    """

    psf: Psf
    frames: FrameFormat = FrameFormat()
    dark: Tensor | None = None
    background: tuple[float, ...] = ()
    pitch_um: float | None = None
    distance_mm: float | None = None

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        frames: FrameFormat = FrameFormat(),
        *,
        dark: str | Path | None = None,
        background: Background = "estimate",
        psf_bin: int | None = None,
        **fields: Any,  # noqa: ANN401
    ) -> "Calibration":
        """Read the picture of a point source.

        Args:
            path: PNG, TIFF or NPY of 8 to 16 bits or floats, grey or colour, linear in light.
            frames: format of the PSF, the dark frame and the captures.
            dark: frame taken with the same exposure and no light; subtracted from the PSF and from captures.
            background: uniform light under the PSF in addition to the dark frame: a fraction of the full scale, or
                ``"estimate"`` (see `estimate_background`). 0 for a PSF without background.
            psf_bin: ``bin`` of the PSF, if it was taken at another resolution than the captures. The crop is scaled
                to cover the same part of the view, and the dark frame is not subtracted from the PSF.
            **fields: fields of `FrameFormat`, which replace those of ``frames``: ``bin=4, bit_depth=12``.

        Raises:
            ImageError: a file cannot be read.
            PsfError: the PSF is saturated, empty, or has neither 1 nor 3 channels.
            ShapeError: the dark frame does not fit, or a mosaic has colours or odd sides.
            ParameterError: a number is outside its range, or a field has another name.
        """
        if "psf_binning" in fields:
            psf_bin = _renamed("psf_binning", "psf_bin", fields.pop("psf_binning"))
        frames = _with_fields(frames, fields)
        dark_frame = None if dark is None else frames.read(dark)
        return cls._from_frame(frames.read(path), frames, dark_frame, background, psf_bin)

    @classmethod
    def from_array(
        cls,
        picture: ArrayPicture,
        frames: FrameFormat = FrameFormat(),
        *,
        dark: ArrayPicture | None = None,
        background: Background = "estimate",
        psf_bin: int | None = None,
        **fields: Any,  # noqa: ANN401
    ) -> "Calibration":
        """Calibrate from a numpy array or PIL picture of a point source.

        Args:
            picture: (H, W) or (H, W, 1 or 3), RGB, row 0 at the top, linear in light; uint8 and uint16 up to their
                type's maximum unless ``bit_depth`` is given, floats up to 1.
            frames: as for `from_file`, as are the other arguments.
            dark: frame taken with the same exposure and no light.
            background: uniform light under the PSF.
            psf_bin: ``bin`` of the PSF.
            **fields: fields of `FrameFormat`.

        Raises:
            ImageError: the array has other axes or numbers.
            MwdnError: as for `from_file`.
        """
        frames = _with_fields(frames, fields)
        dark_frame = None if dark is None else as_frame(dark)
        return cls._from_frame(as_frame(picture), frames, dark_frame, background, psf_bin)

    @classmethod
    def _from_frame(
        cls, frame: Frame, frames: FrameFormat, dark: Frame | None, background: Background, psf_bin: int | None
    ) -> "Calibration":
        _refuse_saturated(frames, frame)
        dark_image = None if dark is None else frames.normalise(dark)
        # The PSF is flipped last, about its centre.
        psf_frames, psf_dark = replace(frames, upside_down=False), dark_image
        if psf_bin is not None and psf_bin != frames.bin:
            psf_frames, psf_dark = psf_frames.with_bin(psf_bin), None
        psf = psf_frames.to_measurement(frame, psf_dark)

        level = _background_level(psf, background)
        psf = (psf - level).clamp(min=0)
        total = psf.sum((-2, -1), keepdim=True)
        if not (total > 0).all():
            raise PsfError(_empty(total.flatten() > 0, level.flatten(), with_dark=dark is not None))
        psf = psf / total
        return cls(
            flip_rows_about_centre(psf) if frames.upside_down else psf,
            frames,
            dark_image,
            background=tuple(round(float(value), 6) for value in level.flatten()),
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
        """Fraction of a raw frame's pixels that are saturated; 0 for floats, which have no known maximum."""
        return self.frames.saturated(frame)[0] / (frame.shape[0] * frame.shape[1])

    def correct(self, frame: ArrayPicture) -> Measurement:
        """Turn a raw frame into a measurement of the PSF's size.

        Args:
            frame: (H, W) or (H, W, C) raw pixel values, RGB: from `FrameFormat.read`, or another numpy array or
                PIL picture of uint8, uint16 or floats.

        Returns:
            (1, C, *size), linear light; 1 is saturation.

        Raises:
            ShapeError: the frame does not fit the PSF.
            ParameterError: a pixel value exceeds the bit depth.
        """
        measurement = self.frames.to_measurement(as_frame(frame, finite=False), self.dark)
        size = measurement.shape[-2], measurement.shape[-1]
        if size != self.size:
            raise ShapeError(
                f"`psf` ({self.size[0]} x {self.size[1]}) and the capture ({size[0]} x {size[1]}) must have the same "
                f"height and width. {_advise(size, self.size, self.frames.bin)}"
            )
        if measurement.shape[1] == 1 and self.psf.shape[1] == 3:
            raise ShapeError(
                "The capture is grey, but `psf` has colours. Use both as grey: `--grey`. If the capture is the raw "
                "frame of a colour sensor, give the order of its filters: `--mosaic rggb`."
            )
        return measurement


def estimate_background(image: Image) -> Tensor:
    """Background level of a PSF, (1, C, 1, 1): the 5th percentile of each channel.

    A PSF is dark between its lines; stray light and the sensor's offset fill these places uniformly. A lower
    percentile would follow the noise of the darkest pixels, a higher one the tails of the PSF itself: on the
    paper's camera 5 % gives the sharpest reconstructions, 50 % washes them out.
    """
    pixels = image.flatten(2).sort(dim=-1).values
    return pixels[..., int(0.05 * pixels.shape[-1])][..., None, None]


def flip_rows_about_centre(psf: Psf) -> Psf:
    """Reverse the rows of a PSF and keep its centre at ``H // 2``: an even height needs a shift by one row.

    A capture is flipped without this shift: it has no centre to keep, and its last row would become its first.
    """
    flipped = psf.flip(-2)
    return flipped.roll(1, -2) if psf.shape[-2] % 2 == 0 else flipped


def _with_fields(frames: FrameFormat, fields: dict[str, Any]) -> FrameFormat:
    """The format with these fields replaced; a `ParameterError` names one that it does not have."""
    if "binning" in fields:
        fields["bin"] = _renamed("binning", "bin", fields.pop("binning"))
    check_options(FrameFormat, "`Calibration`", fields)
    return replace(frames, **fields)


def _renamed(old: str, new: str, value: int | None) -> int | None:
    warnings.warn(f"`{old}` is now called `{new}`: `{new}={value}`.", DeprecationWarning, stacklevel=4)
    return value


def _refuse_saturated(frames: FrameFormat, frame: Frame) -> None:
    count, maximum = frames.saturated(frame)
    pixels = frame.shape[0] * frame.shape[1]
    if count > SATURATED_PART * pixels:
        raise PsfError(
            f"PSF is saturated: {count:,} of {pixels:,} pixels are at the {maximum.bit_length()}-bit maximum "
            f"{maximum}. Lower the exposure and capture it again."
        )


def _background_level(psf: Tensor, background: Background) -> Tensor:
    if background == "estimate":
        return estimate_background(psf).clamp(min=0)  # negative if the file's background was subtracted before
    if not 0 <= background < 1:
        raise ParameterError(f"`background` ({background}) must be in [0, 1), a fraction of the full scale.")
    return torch.full((1, psf.shape[1], 1, 1), float(background))


def _empty(has_light: Tensor, level: Tensor, *, with_dark: bool) -> str:
    names = ["grey"] if len(has_light) == 1 else ["red", "green", "blue"]
    empty = [name for name, light in zip(names, has_light.tolist(), strict=True) if not light]
    advice = ["Expose longer"]
    advice += ["take the dark frame without light"] if with_dark else []
    advice += ["give `--background 0`"] if level.max() > 0 else []
    return (
        f"PSF is empty: no light is left in {', '.join(empty)} after subtracting the background "
        f"({', '.join(f'{v:.3g}' for v in level)} of the full scale). {', or '.join(advice)}."
    )


def _advise(capture: Size, psf: Size, bin: int) -> str:
    for larger, smaller, name, options in (
        (psf, capture, "PSF", "--psf-bin {product}"),
        (capture, psf, "capture", "--bin {product} --psf-bin {bin}"),
    ):
        factor = larger[0] // smaller[0]
        if factor > 1 and larger == (smaller[0] * factor, smaller[1] * factor):
            options = options.format(product=bin * factor, bin=bin)
            return f"The {name} is {factor} times as large: bin it by {factor}, `{options}`."
    if psf[0] <= capture[0] and psf[1] <= capture[1]:
        return f"Crop the capture around its centre: `--crop {psf[0] * bin} {psf[1] * bin}`."
    return "Use the PSF that belongs to this camera."
