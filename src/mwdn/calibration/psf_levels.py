"""The levels of a PSF's frame: saturation, background, darkness."""

import torch
from torch import Tensor

from mwdn.calibration.exposure import measure_exposure
from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.psf_format import Background
from mwdn.errors import ParameterError, PsfError
from mwdn.types import Frame, Image

SATURATED_PART = 1e-3
"""Largest fraction of saturated pixels in a PSF: a few hot pixels do no harm, saturated lines do. 102 of 320 x 320."""


def estimate_background(image: Image) -> Tensor:
    """Background level of a PSF, (1, C, 1, 1): the 5th percentile of each channel.

    A PSF is dark between its lines; stray light and the sensor's offset fill these places uniformly. A lower
    percentile would follow the noise of the darkest pixels, a higher one the tails of the PSF itself: on the
    paper's camera 5 % gives the sharpest reconstructions, 50 % washes them out.
    """
    pixels = image.flatten(2).sort(dim=-1).values
    return pixels[..., int(0.05 * pixels.shape[-1])][..., None, None]


def check_psf_frame(frames: FrameFormat, frame: Frame) -> None:
    """Check the raw frame of a PSF.

    Raises:
        ParameterError: see `FrameFormat.check_bits`.
        PsfError: more than `SATURATED_PART` of it is saturated.
    """
    try:
        frames.check_bits(frame, "`psf`")
    except ParameterError as error:
        raise ParameterError(f"{error} If the PSF has other bits than the captures: `psf_bit_depth`.") from error
    count, maximum = frames.saturated(frame)
    pixels = frame.shape[0] * frame.shape[1]
    if count > SATURATED_PART * pixels:
        raise PsfError(
            f"PSF is saturated: {count:,} of {pixels:,} pixels are at the {maximum.bit_length()}-bit maximum "
            f"{maximum}. Lower the exposure and capture it again: use {measure_exposure(frame, frames).next(None)}."
        )


def background_level(psf: Tensor, background: Background) -> Tensor:
    """The level to subtract from each channel of a PSF, (1, C, 1, 1)."""
    if background == "estimate":
        return estimate_background(psf).clamp(min=0)  # negative if the file's background was subtracted before
    return torch.full((1, psf.shape[1], 1, 1), float(background))


def check_light(total: Tensor, level: Tensor, *, with_dark: bool) -> None:
    """Raise a `PsfError` if a channel's sum, ``total`` (C,), is not positive after its level (C,) was subtracted."""
    names = ["grey"] if len(total) == 1 else ["red", "green", "blue"]
    empty = [name for name, light in zip(names, total.tolist(), strict=True) if not light > 0]
    if not empty:
        return
    advice = ["Expose longer"]
    advice += ["take the dark frame without light"] if with_dark else []
    advice += ["give `background=0`"] if level.max() > 0 else []
    raise PsfError(
        f"PSF is empty: no light is left in {', '.join(empty)} after subtracting the background "
        f"({', '.join(f'{v:.3g}' for v in level)} of the full scale). {', or '.join(advice)}."
    )
