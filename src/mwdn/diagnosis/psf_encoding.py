"""Whether the PSF's file is gamma-coded, from what it explains of a capture with the stored and with decoded numbers.

Light adds up linearly, so only a linear PSF explains a linear capture. But decoding makes any PSF sharper, and a
sharper PSF explains more fine detail of any capture, even a mirrored PSF, which belongs to no camera. So what counts is
how much the best of its half turns and mirror images leads the second best, as in `mwdn.diagnosis.sizes`; with m the
misfits of `mwdn.solvers.spectral_misfit`,

    lead = log(second smallest m / smallest m)
    score = lead(decoded) - lead(stored) - log(smallest m(decoded) / smallest m(stored)) / 10

Decoding also removes haze, of which the PSF's file may have too much. Then coarse detail is explained worse, so for a
coded PSF the misfits at a quarter of the size (`mwdn.diagnosis.encoding`) must agree: with q the logarithm of the
linear PSF's over the coded one's, the score is sqrt(score q) at most, and 0 if q is negative.

A coded PSF above a bright background, or in a noisy capture, hardly differs from a linear one and is not detected.
"""

import math
from dataclasses import dataclass, field, replace

from mwdn.calibration import Calibration
from mwdn.diagnosis.encoding import as_linear_and_coded, misfits
from mwdn.diagnosis.orientation import CLEAR, HALF_TURNS, fit_turns
from mwdn.diagnosis.verdict import Verdict
from mwdn.types import Frame

LINEAR = -0.06
"""Score below which a PSF is linear. Of 100 simulated captures (seeds 1, 2), coded PSFs have -0.04 and more."""

CODED = 0.1
"""Score above which it is coded. Linear PSFs have 0.07 and less."""

MAX_CAPTURES = 3
"""Largest number of captures from which the gamma of a PSF's file is detected."""


def psf_gamma(frame: Frame, calibration: Calibration, capture: str, *, for_viewing: bool = False) -> Verdict:
    """Whether the PSF's file is linear in light, and whether ``--psf-gamma`` says so.

    The value is "linear" or "srgb"; a power of 2.2 counts as sRGB.

    Args:
        frame: (H, W, C) of a capture, numbers as stored.
        calibration: the camera's; the capture must fit its PSF.
        capture: "linear" or "srgb", what `mwdn.diagnosis.encoding.gamma` detected; empty if it cannot tell.
        for_viewing: the PSF's file is of a type for viewing, such as JPEG.
    """
    score = _score(frame, calibration, capture) if capture else 0.0
    is_coded = score > CODED
    is_given = calibration.psf_format.psf_gamma is not None
    if score < LINEAR:
        text = "The PSF's file looks linear in light: decoded from sRGB it explains the capture worse"
        if is_given:
            return Verdict("psf", "psf-gamma", "doubt", f"{text}. Leave out `--psf-gamma`.", "linear")
        return Verdict("psf", "psf-gamma", "good", f"{text}.", "linear")
    if is_coded or for_viewing:
        reason = "decoded from sRGB it explains the capture better" if is_coded else "it is a JPEG or WebP"
        text = f"The PSF's file looks gamma-coded: {reason}"
        if is_given:
            return Verdict("psf", "psf-gamma", "good", f"{text}.", "srgb")
        return Verdict("psf", "psf-gamma", "doubt", f"{text}.", "srgb", "--psf-gamma srgb")
    text = "This capture cannot tell whether the PSF's file is gamma-coded."
    return Verdict("psf", "psf-gamma", "unknown", text)


@dataclass
class PsfGammaTest:
    """`psf_gamma` of the first captures of a camera, a second each, until one gives a result.

    Args:
        calibration: the camera's.
        for_viewing: as for `psf_gamma`.
        known: verdicts so far.
    """

    calibration: Calibration
    for_viewing: bool = False
    known: list[Verdict] = field(default_factory=list)

    def __call__(self, frame: Frame, verdicts: tuple[Verdict, ...]) -> tuple[Verdict, ...]:
        """The verdict, if there is one.

        Args:
            frame: (H, W, C) of a capture, numbers as stored.
            verdicts: on this capture, see `mwdn.diagnosis.captures.examine_capture`.
        """
        gamma = [verdict.value for verdict in verdicts if verdict.topic == "gamma"]
        if gamma and len(self.known) < MAX_CAPTURES and all(verdict.state == "unknown" for verdict in self.known):
            self.known.append(psf_gamma(frame, self.calibration, gamma[0], for_viewing=self.for_viewing))
        return tuple(self.known[-1:])


def _score(frame: Frame, calibration: Calibration, capture: str) -> float:
    """See above; 0 if no orientation of the PSF leads clearly."""
    if (capture == "linear") == (calibration.frames.gamma is None):
        measurement = calibration.to_measurement(frame)
    else:  # without the dark frame, which was read with the wrong gamma, too
        measurement = replace(calibration.frames, gamma=None if capture == "linear" else "srgb").to_measurement(frame)
    linear, coded = (fit_turns(measurement, psf, HALF_TURNS) for psf in as_linear_and_coded(calibration))
    if max(linear.lead, coded.lead) < CLEAR:
        return 0.0
    better = min(coded.misfits.values()) / min(linear.misfits.values())
    score = math.log(coded.lead / linear.lead) - math.log(better) / 10
    if score <= 0:
        return score
    return min(score, math.sqrt(score * max(0.0, misfits(frame, calibration).of_psf(capture))))
