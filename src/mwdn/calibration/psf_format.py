"""Where the picture of the point source differs from the camera's captures."""

import warnings
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from torch import Tensor

from mwdn.arguments import check_at_least, checked
from mwdn.calibration.frame_format import FrameFormat, Gamma, check_gamma
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.optics.orientation import Orientation, check_orientation, swaps_axes, turn

Background = float | Literal["estimate"]
"""A level as a fraction of the full scale, or ``"estimate"``."""


@checked
@dataclass(frozen=True, kw_only=True)
class PsfFormat:
    """Where the picture of the point source differs from the captures.

    Args:
        background: uniform light under the PSF in addition to the dark frame: a fraction of the full scale, or
            ``"estimate"``, which takes it from the darkest pixels. 0 for a PSF without background.
        psf_bin: ``bin`` of the PSF, if it was taken at another resolution than the captures. ``crop`` is scaled to
            cover the same part of the view, and the dark frame is not subtracted from the PSF.
        psf_bit_depth: bits of the PSF's numbers, if it was taken with others than the captures.
        psf_gamma: encoding of the PSF's file, as ``gamma`` for captures: linear unless given.
        psf_orientation: how the PSF must be turned to fit the captures, about its centre. It is turned last, so crop
            is that of the captures; the dark frame is not subtracted from the PSF.

    Raises:
        ParameterError: a number is outside its range.
        UnknownNameError: no such orientation.
    """

    background: Background = "estimate"
    psf_bin: int | None = None
    psf_bit_depth: int | None = None
    psf_gamma: Gamma | None = None
    psf_orientation: Orientation | None = None

    def __post_init__(self) -> None:
        if self.background != "estimate" and not 0 <= self.background < 1:
            raise ParameterError(
                f"`background` ({self.background}) must be in [0, 1), a fraction of the full scale, or 'estimate'."
            )
        if self.psf_bin is not None:
            check_at_least(1, psf_bin=self.psf_bin)
        if self.psf_bit_depth is not None and not 1 <= self.psf_bit_depth <= 16:
            raise ParameterError(f"`psf_bit_depth` ({self.psf_bit_depth}) must be 1 to 16.")
        check_gamma("psf_gamma", self.psf_gamma)
        if self.psf_orientation is not None:
            check_orientation(self.psf_orientation)

    def own_frames(self, captures: FrameFormat) -> FrameFormat:
        """Format of the PSF's own file, before `turn`."""
        frames = captures if self.psf_bin is None else captures.with_bin(self.psf_bin)
        crop = frames.crop[::-1] if frames.crop and swaps_axes(self.psf_orientation) else frames.crop
        bits = self.psf_bit_depth or frames.bit_depth
        return replace(frames, bit_depth=bits, gamma=self.psf_gamma, crop=crop, upside_down=False)

    def shares_pixels(self, captures: FrameFormat) -> bool:
        """Whether the pixels of the PSF's file are those of the captures, so that their dark frame fits it."""
        return self.psf_bin in (None, captures.bin) and self.psf_orientation is None

    def turn(self, psf: Tensor, captures: FrameFormat) -> Tensor:
        """Turn a PSF read with `own_frames` to the orientation of the measurements."""
        if captures.upside_down:
            psf = turn(psf, "flip-top-bottom")
        return psf if self.psf_orientation is None else turn(psf, self.psf_orientation)


def with_options(frames: FrameFormat, psf_format: PsfFormat, options: dict[str, Any]) -> tuple[FrameFormat, PsfFormat]:
    """The formats with these fields replaced.

    Raises:
        UnknownNameError: neither has a field of this name.
    """
    options = current_options(options)
    names, psf_names = ({field.name for field in fields(kind)} for kind in (FrameFormat, PsfFormat))
    for name in options:
        if name not in names | psf_names:
            raise UnknownNameError("option of `Calibration`", name, sorted(names | psf_names))
    of_frames = {name: value for name, value in options.items() if name in names}
    of_psf = {name: value for name, value in options.items() if name in psf_names}
    return replace(frames, **of_frames), replace(psf_format, **of_psf)


def current_options(options: dict[str, Any]) -> dict[str, Any]:
    """The options with ``binning`` and ``psf_binning`` under their present names, with a warning."""
    renamed = {"binning": "bin", "psf_binning": "psf_bin"}
    for old in renamed.keys() & options.keys():
        new, value = renamed[old], options[old]
        warnings.warn(f"`{old}` is now called `{new}`: `{new}={value}`.", DeprecationWarning, stacklevel=4)
    return {renamed.get(name, name): value for name, value in options.items()}
