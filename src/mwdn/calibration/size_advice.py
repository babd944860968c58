"""What to do about a capture that has another size than the PSF."""

from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.psf_format import PsfFormat
from mwdn.types import Size

MIN_PSF_PX = 15
"""Minimum height and width of a PSF in pixels. `mwdn.diagnosis.trust` accepts the right PSF of 12 pixels for 1 or 2
captures in 10, of 15 pixels for 7 or 8."""


def advise_size(capture: Size, psf: Size, frames: FrameFormat, psf_format: PsfFormat) -> str:
    """The options with which a capture and a PSF of different sizes fit."""
    own = psf_format.psf_bin or frames.bin
    for larger, smaller, name, options in (
        (psf, capture, "PSF", "psf_bin={psf}"),
        (capture, psf, "capture", "bin={capture}, psf_bin={own}"),
    ):
        factor = larger[0] // smaller[0]
        if factor > 1 and min(smaller) >= MIN_PSF_PX and larger == (smaller[0] * factor, smaller[1] * factor):
            options = options.format(psf=own * factor, capture=frames.bin * factor, own=own)
            return f"The {name} is {factor} times as large: bin it by {factor}, `{options}`."
    if psf[0] <= capture[0] and psf[1] <= capture[1]:
        raw = frames.bin * frames.cell
        return f"Crop the capture around its centre: `crop=({psf[0] * raw}, {psf[1] * raw})`."
    return "Use the PSF that belongs to this camera."
