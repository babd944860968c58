"""Whether a PSF is this camera's, mirrored or turned: compares the PSF with its mirror images and quarter turns.

It depends on the measurement and the PSF alone, not on the method or its options. The right one explains the fine
detail clearly better than the others (`mwdn.solvers.spectral_misfit`); a PSF of another camera explains about as much
in any orientation.
"""

from dataclasses import dataclass, replace
from typing import cast, get_args

import torch

from mwdn.diagnosis.noise import noise_bounds
from mwdn.diagnosis.verdict import Verdict
from mwdn.optics.orientation import Orientation, compose, swaps_axes, turn
from mwdn.optics.saturation import saturated_pixels
from mwdn.solvers.pose import Pose
from mwdn.solvers.spectral_misfit import spectral_misfit
from mwdn.types import Measurement, Psf

HALF_TURNS = ("", *(name for name in get_args(Orientation) if not swaps_axes(name)))
"""No turn, mirror images, and a turn by 180 degrees: those of any frame."""

QUARTER_TURNS = tuple(name for name in get_args(Orientation) if swaps_axes(name))
"""Turns that exchange rows and columns: those of a square frame only."""

CLEAR = 1.17
"""Lead above which the best orientation is certain."""

MIN_LEAD = 1.12
"""Lead below which no orientation of the PSF fits: it is another camera's."""

MAX_NOISE = 0.6
"""`OrientationFit.noise` above which orientations fit alike even if one of them is right."""

MIN_CAPTURE_PX = 96
"""Height and width in pixels of a capture below which that is so, too."""

MAX_SATURATED = 0.1
"""Fraction of saturated pixels above which only a PSF that fits is judged. Of nine real captures through the right PSF,
clipped at 20 %, one seems turned, and three fit all orientations alike (`benchmarks/trust.py --saturated`)."""


@dataclass(frozen=True)
class OrientationFit:
    """Misfits of a PSF in all its orientations.

    Args:
        misfits: by the name of the turn, empty for the PSF as it is: the mean part of a band of detail that no scene
            explains. A frame that is not square has no quarter turns.
        noise: upper bound of the part of the capture's detail that is noise.
        side: the shorter one of the capture, in pixels.
        saturated: fraction of the capture's pixels that are saturated.
        given: turn that the PSF already had; the option that is advised replaces it.
    """

    misfits: dict[str, float]
    noise: float
    side: int
    saturated: float = 0.0
    given: Orientation | None = None

    @property
    def contrast(self) -> float:
        """Smallest misfit of the other orientations over that of the PSF as it is."""
        return min(value for name, value in self.misfits.items() if name) / self.misfits[""]

    @property
    def best(self) -> str:
        """The turn after which the PSF fits best; empty for none."""
        return min(self.misfits, key=self.misfits.__getitem__)

    @property
    def lead(self) -> float:
        """Misfit of the second best orientation over that of the best."""
        first, second = sorted(self.misfits.values())[:2]
        return second / first

    @property
    def verdict(self) -> Verdict:
        """Right, another orientation, another camera's, or cannot be judged."""
        if self.lead >= CLEAR and not self.best:
            text = f"The PSF fits: any other orientation leaves {self.lead - 1:.0%} more unexplained."
            return Verdict("psf", "orientation", "good", text)
        if self.saturated > MAX_SATURATED:
            text = f"The PSF cannot be judged: {self.saturated:.0%} of the capture's pixels are saturated."
            return Verdict("psf", "orientation", "unknown", text)
        if self.lead >= CLEAR:
            right = compose(self.given, cast(Orientation, self.best)) or "none"
            text = f"The PSF is mirrored or turned: as it is, it leaves {self.contrast**-1 - 1:.0%} more unexplained."
            return Verdict("psf", "orientation", "doubt", text, right, f"--psf-orientation {right}")
        alike = f"The PSF's mirror images and turns fit the capture alike (to {self.lead - 1:.0%})"
        if self.lead >= MIN_LEAD or self.noise > MAX_NOISE or self.side < MIN_CAPTURE_PX:
            return Verdict("psf", "orientation", "unknown", f"{alike}: the PSF cannot be judged by this capture.")
        text = f"{alike}: it is another camera's, or at another resolution."
        return Verdict("psf", "another-camera", "doubt", text, "another-camera")


def fit_orientations(
    measurement: Measurement, psf: Psf, *, pose: Pose | None = None, given: Orientation | None = None
) -> OrientationFit:
    """Fit the best scene through a PSF in each orientation.

    If no half turn or mirror image leads clearly, quarter turns are tried, and then the PSF without its pose, because a
    pose estimated in a wrong orientation is meaningless.

    Args:
        measurement: (1, C, H, W).
        psf: (1, 1 or C, H, W), centred.
        pose: best pose of the PSF (`align`).
        given: turn that the PSF already had, for the advice.
    """
    fit = _fit(measurement, psf if pose is None else pose.move(psf))
    if pose is not None and fit.lead < CLEAR:
        fit = max(fit, _fit(measurement, psf), key=lambda fit: fit.lead)
    return replace(fit, given=given)


def _fit(measurement: Measurement, psf: Psf) -> OrientationFit:
    fit = fit_turns(measurement, psf, HALF_TURNS)
    if fit.lead < CLEAR and psf.shape[-2] == psf.shape[-1]:
        others = fit_turns(measurement, psf, QUARTER_TURNS)
        fit = replace(fit, misfits={**fit.misfits, **others.misfits})
    return fit


def fit_turns(measurement: Measurement, psf: Psf, turns: tuple[str, ...]) -> OrientationFit:
    """Fit the best scene through a PSF after each of these turns; an empty name is none."""
    psfs = [turn(psf, cast(Orientation, name)) if name else psf for name in turns]
    misfits = spectral_misfit(measurement, torch.cat(psfs)).exp().tolist()
    return OrientationFit(
        dict(zip(turns, misfits, strict=True)),
        noise=noise_bounds(measurement).high,
        side=min(measurement.shape[-2:]),
        saturated=float(saturated_pixels(measurement).float().mean()),
    )
