"""Whether a capture is gamma-coded, from its noise and from what the PSF explains of it.

**Noise.** The shot noise of a linear sensor has a variance proportional to the level. A power 1 / g turns the level x
into ``y = x^(1/g)`` and its variance into ``(dy/dx)^2 x = y^(2 - g) / g^2``: for g = 2.2 it is nearly constant. So the
slope of log(variance) against log(level) is 1 for linear captures and -0.2 for coded ones; read noise makes it 0.6 and
-0.8. Detail of the picture adds a variance that grows with the level, and rounding to 8 bits or JPEG hides the noise.

**Misfit.** Light adds up linearly, so a scene explains a linear capture through the PSF, but not a power of the
capture. With decoded and stored numbers in turn, a non-negative scene is fitted at a quarter of the size; the part of
the capture's detail that is left is compared. An even background does not count as detail. The PSF's file may be coded,
too, so the PSF is tried as stored and decoded, and the better one counts.

**File.** Cameras and programs write gamma-coded JPEGs, practically always.

Each gives the logarithm of a likelihood ratio, positive for linear captures. They are added.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from mwdn.calibration import Calibration
from mwdn.calibration.frame_operations import bin_pixels
from mwdn.diagnosis.verdict import Verdict
from mwdn.io.raw import Mosaic
from mwdn.optics.psf import unit_sum
from mwdn.solvers.alignment import fine_detail
from mwdn.solvers.levels import Level
from mwdn.solvers.pyramid import halve, solve
from mwdn.solvers.splitting import Penalties
from mwdn.types import Frame, Image, Psf

FloatArray = npt.NDArray[np.float64]

BLOCK_PX = 8
"""Pixels along each side of a block whose noise and level are measured."""

LEVEL_GROUPS = 10
"""Groups of blocks of similar level. The median over a group ignores blocks with sharp detail."""

NOISE_SIDE_PX = 1024
"""Pixels along each side of the noise measurement, in the middle of the frame."""

MIN_MEASUREMENT_PX = 64
"""Pixels along each side that a measurement must have."""

MIN_EVIDENCE = 1.3
"""Smallest logarithm of the likelihood ratio that decides: 1.1 gave 4 wrong answers of 200 with seed 28, 1.3 gives 3,
and none of 200 with seed 29, which was not used to choose it."""

FOR_VIEWING = -0.8
"""Logarithm of the likelihood ratio of a file type for viewing. Of 90 simulated and 60 real JPEGs, coded ones have
other evidence of -0.6 and less, and linear ones, rare but for simulations, -0.3 and more."""

# At an eighth to a quarter of the frame's size, where noise is low and detail is left.
_LEVELS = (Level(2, 20, Penalties(0.15, 0.0, 0.6)), Level(1, 12, Penalties(0.1, 1.5, 1.5), 0.02, min_smoothing=0.5))
_SIDE = 256  # pixels of the shorter side, about, before it is halved twice


class NoiseSlope(NamedTuple):
    """How the variance of the noise grows with the level.

    Args:
        slope: exponent of the level.
        error: standard error of the slope: scatter, and noise that is hidden by rounding.
    """

    slope: float
    error: float

    @property
    def evidence(self) -> float:
        """Logarithm of the likelihood ratio of normal distributions of mean 1 and -0.1, with a spread of 0.3.

        Noise has no slope outside -0.85 to 1.75: what is beyond adds to the error.
        """
        difference = self.slope - 0.45
        beyond = max(0.0, abs(difference) - 1.3)
        ratio = 1.1 * difference / (0.3**2 + self.error**2 + beyond**2)
        return max(-6.0, min(6.0, ratio))


class Misfits(NamedTuple):
    """Part of a capture's detail that the best scenes leave unexplained.

    Args:
        linear_psf: part of the detail of the numbers as stored, and of them decoded from sRGB, if the PSF is linear.
        coded_psf: the same if the PSF is decoded, too.
        change: part of the detail that differs between the two; small for a capture of low contrast.
    """

    linear_psf: tuple[float, float]
    coded_psf: tuple[float, float]
    change: float

    @property
    def stored(self) -> float:
        """Part that is left of the numbers as stored, by the better PSF."""
        return min(self.linear_psf[0], self.coded_psf[0])

    @property
    def decoded(self) -> float:
        """Part that is left of the decoded numbers, by the better PSF."""
        return min(self.linear_psf[1], self.coded_psf[1])

    @property
    def evidence(self) -> float:
        """Logarithm of the likelihood ratio, chosen on 400 variants (`benchmarks/diagnosis.py`, seeds 1, 2)."""
        ratio = 2.5 * (math.log(self.decoded / self.stored) - 0.5) * min(1.0, self.change / 0.07)
        return max(-4.0, min(4.0, ratio))

    def of_psf(self, capture: str) -> float:
        """Logarithm of the misfit of the linear PSF over that of the decoded, of a "linear" or "srgb" capture."""
        number = 0 if capture == "linear" else 1
        return math.log(self.linear_psf[number] / self.coded_psf[number])


def gamma(frame: Frame, calibration: Calibration, *, for_viewing: bool = False) -> Verdict:
    """Whether a capture is linear in light, and whether ``--gamma`` says so.

    The value is "linear" or "srgb"; a power of 2.2 counts as sRGB.

    Args:
        frame: (H, W, C), numbers as stored.
        calibration: the camera's; the capture must fit its PSF.
        for_viewing: the capture's file is of a type for viewing, such as JPEG.
    """
    if min(calibration.size) < MIN_MEASUREMENT_PX:
        return Verdict("capture", "gamma", "unknown", "The capture is too small to show whether it is gamma-coded.")
    if frame.min() < 0 and calibration.frames.gamma is None:
        return Verdict(
            "capture", "gamma", "good", "The capture has numbers below 0, so it is not gamma-coded.", "linear"
        )
    slope = noise_slope(frame, calibration)
    evidence, reasons = slope.evidence, [f"its noise has a variance proportional to level^{slope.slope:.1f}"]
    if abs(evidence) < 3 * MIN_EVIDENCE:
        fits = misfits(frame, calibration)
        evidence += fits.evidence
        reasons = reasons if abs(slope.evidence) > MIN_EVIDENCE / 2 else []
        reasons += [f"the PSF leaves {fits.stored:.1%} of its detail unexplained, decoded from sRGB {fits.decoded:.1%}"]
    if for_viewing:
        evidence += FOR_VIEWING
        reasons += ["it is a JPEG or WebP"] if evidence < 0 else []
    if abs(evidence) < MIN_EVIDENCE:
        text = "This capture cannot tell whether it is gamma-coded. Frames of a sensor are linear, JPEGs are coded."
        return Verdict("capture", "gamma", "unknown", text)
    is_linear, is_decoded = evidence > 0, calibration.frames.gamma is not None
    text = f"The capture looks {'linear in light' if is_linear else 'gamma-coded'}: {'; '.join(reasons)}"
    if is_linear and is_decoded:
        return Verdict("capture", "gamma", "doubt", f"{text}. Leave out `--gamma`.", "linear")
    if is_linear or is_decoded:
        return Verdict("capture", "gamma", "good", f"{text}.", "linear" if is_linear else "srgb")
    return Verdict("capture", "gamma", "doubt", f"{text}.", "srgb", "--gamma srgb")


def noise_slope(frame: Frame, calibration: Calibration) -> NoiseSlope:
    """Measure the slope in the green pixels, in the middle of the frame."""
    y, step = _green(frame, calibration.frames.mosaic)
    d = y[1:, 1:] - y[:-1, 1:] - y[1:, :-1] + y[:-1, :-1]  # four times the variance of white noise
    variance, level = _blocks(d * d / 4).mean((1, 3)).ravel(), _blocks(y[:-1, :-1]).mean((1, 3)).ravel()
    lit = (level > 0.02 * level.max(initial=0)) & (level < 0.97 * y.max(initial=0))
    if lit.sum() < 4 * LEVEL_GROUPS:
        return NoiseSlope(0.0, math.inf)
    groups = np.array_split(np.argsort(level[lit]), LEVEL_GROUPS)
    x = np.log([level[lit][group].mean() for group in groups])
    total = np.array([np.median(variance[lit][group]) for group in groups])
    rounding = step**2 / 12
    # At least half of the rounding's variance, so that a group of flat blocks has a logarithm.
    z = np.log(np.maximum(total - rounding, rounding / 2) + 1e-30)
    spread = ((x - x.mean()) ** 2).sum()
    slope = ((x - x.mean()) * z).sum() / max(spread, 1e-12)
    scatter = ((z - z.mean() - slope * (x - x.mean())) ** 2).sum() / (LEVEL_GROUPS - 2) / max(spread, 1e-12)
    hidden = 1.8 * rounding / max(float(np.median(total)) - rounding, 1e-6 * rounding + 1e-30)
    return NoiseSlope(float(slope), math.sqrt(4 * scatter + hidden**2))


def misfits(frame: Frame, calibration: Calibration) -> Misfits:
    """Fit scenes to the green of a capture as stored and decoded."""
    captures = [replace(calibration.frames, gamma=gamma).to_measurement(frame) for gamma in (None, "srgb")]
    factor = max(1, round(min(calibration.size) / _SIDE))
    both = bin_pixels(torch.cat([_middle(image) for image in captures]).clamp(0, 1), factor)
    both = halve(halve(both))
    both = both / both.amax((1, 2, 3), keepdim=True).clamp(min=1e-30)
    detail = fine_detail(both).flatten(1)
    energy = detail.square().sum(1)
    if energy.amin() <= 0:
        return Misfits((1.0, 1.0), (1.0, 1.0), 0.0)
    # Binned, not halved: the blur by `halve` in the capture counts as a blur of the scene, not of the PSF.
    psfs = [bin_pixels(_middle(psf), 4 * factor) for psf in as_linear_and_coded(calibration)]
    left = (fine_detail(solve(both, psf, _LEVELS).residual).flatten(1).square().sum(1) for psf in psfs)
    linear_psf, coded_psf = ((energies / energy).clamp(min=1e-6).tolist() for energies in left)
    change = 1 - float((detail[0] @ detail[1]).square() / energy.prod())
    return Misfits(tuple(linear_psf), tuple(coded_psf), change)


def as_linear_and_coded(calibration: Calibration) -> tuple[Psf, Psf]:
    """The PSF if its file is linear, and if it holds light raised to the power of 1 / 2.2.

    The background is added back, decoded or encoded with the PSF, and subtracted again: numbers that were clipped at
    the background stay there.
    """
    psf, channels = calibration.psf, (1, -1, 1, 1)
    light = torch.tensor(calibration.light or [1.0]).reshape(channels)
    level = torch.tensor(calibration.background or [0.0]).reshape(channels)
    power = 2.2 if calibration.psf_format.psf_gamma is None else 1 / 2.2
    other = unit_sum((psf * light + level) ** power - level**power)
    return (psf, other) if calibration.psf_format.psf_gamma is None else (other, psf)


def _middle(image: Image) -> Tensor:
    """The green channel, or the only one: (1, 1, H, W)."""
    return image[:, image.shape[1] // 2][:, None]


def _green(frame: Frame, mosaic: Mosaic | None) -> tuple[FloatArray, float]:
    """Green pixels (h, w) in the middle of a frame over the largest number, and the smallest step of their numbers."""
    if mosaic is None:
        plane = frame[..., frame.shape[-1] // 2]
    else:
        row, column = divmod(mosaic.index("g"), 2)
        plane = frame[row::2, column::2, 0]
    rows, columns = (slice(max(0, (n - NOISE_SIDE_PX) // 2), (n + NOISE_SIDE_PX) // 2) for n in plane.shape)
    plane = plane[rows, columns].astype(np.float64)
    scale = max(float(plane.max()), 1e-30)
    steps = np.diff(np.unique(plane))
    return plane / scale, float(steps.min(initial=np.inf)) / scale if len(steps) else 1.0


def _blocks(plane: FloatArray) -> FloatArray:
    """Blocks of pixels: (rows, BLOCK_PX, columns, BLOCK_PX)."""
    rows, columns = (length // BLOCK_PX for length in plane.shape)
    return plane[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX)
