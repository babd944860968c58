"""How a PSF fits captures of another size: the bin, or the quarter turn, that explains a capture.

If height and width are exchanged, the quarter turns are tried first. Then PSF or capture is binned, and both are
cropped to what they have in common. At the right bin one orientation of the PSF explains the capture better than all
others (`mwdn.solvers.spectral_misfit`):

    lead(bin) = second smallest log misfit - smallest log misfit, over the PSF's orientations

At a wrong bin the PSF is no better than its mirror images, which belong to no camera, and the lead is about 0. So leads
can be compared between bins, although the misfit itself falls with the size of the PSF.
"""

import math
from typing import NamedTuple, cast

from torch.nn import functional as F

from mwdn.calibration import Calibration
from mwdn.calibration.frame_operations import bin_pixels, crop_centre
from mwdn.diagnosis.orientation import CLEAR, HALF_TURNS, QUARTER_TURNS, OrientationFit, fit_turns
from mwdn.diagnosis.verdict import Verdict
from mwdn.errors import ShapeError
from mwdn.optics.orientation import Orientation, compose
from mwdn.types import Measurement, Psf, Size, size_of

BINS = range(1, 9)
"""Bins of the PSF or the capture that are tried."""

MIN_COMMON_PX = 64
"""Pixels of the shorter side that PSF and capture must have in common."""

MAX_FIT_PIXELS = 60_000
"""Pixels of the largest frame that is not halved: 8 bins take a few seconds."""


class Fit(NamedTuple):
    """A PSF binned by ``psf_bin`` and a capture binned by ``bin``, cropped to ``size``; ``lead`` as above."""

    psf_bin: int
    bin: int
    size: Size
    lead: float


def fit_sizes(measurement: Measurement, psf: Psf) -> list[Fit]:
    """All bins of the PSF, and of a capture that is larger than it; the largest lead first.

    Args:
        measurement: (1, C, H, W).
        psf: (1, 1 or C, h, w), centred.
    """
    capture, grey = measurement.mean(1, keepdim=True), psf.mean(1, keepdim=True)
    larger = any(a > b for a, b in zip(capture.shape[-2:], grey.shape[-2:], strict=True))
    bins = [(bin, 1) for bin in BINS] + [(1, bin) for bin in BINS[1:] if larger]
    fits = []
    for psf_bin, bin in bins:
        sides = [min(a // bin, b // psf_bin) for a, b in zip(capture.shape[-2:], grey.shape[-2:], strict=True)]
        if min(sides) >= MIN_COMMON_PX:
            size = sides[0], sides[1]
            both = (crop_centre(bin_pixels(image, by), size) for image, by in ((capture, bin), (grey, psf_bin)))
            fits.append(Fit(psf_bin, bin, size, _lead(*both)))
    return sorted(fits, key=lambda fit: -fit.lead)


def _lead(capture: Measurement, psf: Psf) -> float:
    turns = HALF_TURNS + (QUARTER_TURNS if psf.shape[-2] == psf.shape[-1] else ())
    return math.log(_fit(capture, psf, turns).lead)


def _fit(capture: Measurement, psf: Psf, turns: tuple[str, ...]) -> OrientationFit:
    """`fit_turns` of grey pictures of at most `MAX_FIT_PIXELS` pixels."""
    while capture[0, 0].numel() > MAX_FIT_PIXELS:
        capture, psf = F.avg_pool2d(capture, 2), F.avg_pool2d(psf, 2)
    return fit_turns(capture, psf / psf.sum(), turns)


def fitting_size(measurement: Measurement, calibration: Calibration) -> Verdict:
    """Name the bin and the crop with which the PSF explains a capture of another size, if it does so at one bin only.

    Args:
        measurement: (1, C, H, W), from `Calibration.to_measurement`.
        calibration: the camera's; its bins are factors of the bins in the options.

    Returns:
        A verdict on the PSF. Its value is the bin of the PSF, or ``"1/n"`` if the capture must be binned by n, or the
        orientation of the PSF if it must be turned by a quarter.
    """
    if measurement.shape[-2:] == calibration.psf.mT.shape[-2:]:
        grey = measurement.mean(1, keepdim=True), calibration.psf.mean(1, keepdim=True)
        turns = _fit(*grey, QUARTER_TURNS)
        if turns.lead >= CLEAR:
            right = compose(calibration.psf_format.psf_orientation, cast(Orientation, turns.best)) or "none"
            text = "The capture is turned by a quarter against the PSF."
            return Verdict("psf", "size", "doubt", text, right, f"--psf-orientation {right}")
    fits = fit_sizes(measurement, calibration.psf)
    if not fits or fits[0].lead < math.log(CLEAR) or any(fits[0].lead < 1.5 * fit.lead for fit in fits[1:]):
        text = f"No bin of 1 to {BINS[-1]} explains this capture clearly better than others."
        return Verdict("psf", "size", "unknown", text)
    best = fits[0]
    what, bin, value = ("PSF", best.psf_bin, str(best.psf_bin))
    if best.bin > 1:
        what, bin, value = ("capture", best.bin, f"1/{best.bin}")
    text = f"They fit with the {what} binned by {bin}" if bin != 1 else "They fit without binning"
    text += ", and at no other bin tried."
    sizes = (measurement.shape[-2:], best.bin), (calibration.psf.shape[-2:], best.psf_bin)
    cropped = any(best.size != tuple(length // by for length in size) for size, by in sizes)
    return Verdict("psf", "size", "doubt", text, value, _options(best, calibration, cropped=cropped))


def _options(fit: Fit, calibration: Calibration, *, cropped: bool) -> str:
    frames, given = calibration.frames, calibration.psf_format.psf_bin
    bin, psf_bin = frames.bin * fit.bin, (given or frames.bin) * fit.psf_bin
    options = [f"--bin {bin}"] if bin > 1 else []
    options += [f"--psf-bin {psf_bin}"] if psf_bin != bin or given else []
    options += ["--crop {} {}".format(*(length * bin * frames.cell for length in fit.size))] if cropped else []
    return " ".join(options)


def mismatch(error: ShapeError, measurement: Measurement, calibration: Calibration) -> ShapeError:
    """The error of `Calibration.check_fit`; for sizes that differ, with the bin and crop that explain the capture."""
    capture, psf = (size_of(image) for image in (measurement, calibration.psf))
    if capture == psf:
        return error
    verdict = fitting_size(measurement, calibration)
    if verdict.state == "unknown":
        return ShapeError(f"{error} This is a guess: {verdict.text[0].lower()}{verdict.text[1:]}")
    return ShapeError(
        f"`psf` ({psf[0]} x {psf[1]}) and the capture ({capture[0]} x {capture[1]}) must have the same height and "
        f"width. {verdict.sentence}"
    )
