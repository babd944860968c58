"""The report of a PSF: all its measures."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from mwdn.calibration.psf import Calibration
from mwdn.calibration.psf_levels import estimate_background
from mwdn.errors import PsfError
from mwdn.optics import psf_measures, psf_spectrum
from mwdn.optics.noise import noise_level
from mwdn.optics.sensor import Sensor
from mwdn.types import Frame, Psf, Size

LAMBDAS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Regularisations for which the noise gain is reported."""

NOISES = (0.01, 0.003, 0.001)
"""Noise of a measurement over its mean for which resolution is reported: 10,000, 100,000 and 1,000,000 electrons."""

BELOW_ZERO_SIGMAS = 5
"""Standard deviations of the noise below 0 that noise alone does not reach."""


@dataclass(frozen=True)
class Levels:
    """Exposure and background of the PSF's file.

    Args:
        integers: the file holds a sensor's integers; floats have no full scale.
        peak: largest number, as a fraction of the full scale.
        largest: largest number as stored; 0 for floats.
        saturated: number of pixels at the sensor's maximum.
        background: 5th percentile of each channel, as a fraction of the full scale.
        subtracted: level that was subtracted from each channel.
        pedestal: fraction of the file's light in this background.
        below_zero: fraction of the file's pixels that are below 0 by more than `BELOW_ZERO_SIGMAS` times their noise.
        has_dark: whether a dark frame was subtracted from the PSF.
        between: level between the lines, as a fraction of the full scale; mean of the colours.
        noise: standard deviation of a pixel's noise, as a fraction of the full scale.
        noise_floor: power of the noise in |H|^2, for the PSF of unit sum.
        possible_bit_depth: of the sensor, if its numbers may be in the lower bits of the file's; else ``None``.
    """

    integers: bool
    peak: float
    largest: int
    saturated: int
    background: tuple[float, ...]
    subtracted: tuple[float, ...]
    pedestal: float
    below_zero: float
    has_dark: bool
    between: float
    noise: float
    noise_floor: float
    possible_bit_depth: int | None = None


@dataclass(frozen=True)
class PsfReport:
    """Measures of a PSF.

    Args:
        psf_hash: of the calibration.
        size: height and width.
        levels: of the file; ``None`` without a file.
        support: region of the light.
        peak_width_px: full width of the autocorrelation's peak at half maximum; lines are narrower by about sqrt(2).
        bin: of the file's pixels, as given.
        coarsest_bin: largest value of ``bin`` that loses little, see `mwdn.optics.psf_measures.coarsest_bin`.
        side_lobe: highest value of the autocorrelation besides its peak, and its position (rows, columns).
        weak_part: fraction of the frequencies with less than 1/100 of their ring's power; 0.01 for any random mask.
        dark_rings: frequencies, in cycles per pixel, that have no signal in any direction.
        effective_rank: number of separable patterns that make up the PSF.
        colour_likeness: correlation of the two colours that differ most; 1 if grey.
        noise_gain: variance of the noise in the Wiener estimate over that in the measurement, of the worst channel, by
            lambda.
        detail_kept: fraction of a picture's detail that this estimate keeps, of the worst channel, by lambda.
        resolution_px: width of the finest visible lines in a photograph, by the measurement's noise over its mean;
            infinite if none are visible.
        known_frequency: frequency up to which the PSF exceeds the noise of its file; 0.5 at most.
        depth: correlation with the PSF of the design distance, by the distance of the point; may be empty.
        angle: correlation with the PSF on the axis, by the angle; may be empty.
        off_axis: correlation with the PSF on the axis, by the point's displacement in raw pixels, of the least alike
            if several are displaced as far; may be empty.
        corrected: the PSF's file was made by `mwdn calibrate FRAMES`.
        defects: number of hot and dead pixels, if they were sought.
        sensor: full well and read noise in electrons of a raw pixel, if they were measured.
    """

    psf_hash: str
    size: Size
    levels: Levels | None
    support: psf_measures.Support
    peak_width_px: float
    bin: int
    coarsest_bin: int
    side_lobe: tuple[float, tuple[int, int]]
    weak_part: float
    dark_rings: tuple[float, ...]
    effective_rank: float
    colour_likeness: float
    noise_gain: dict[float, float]
    detail_kept: dict[float, float]
    resolution_px: dict[float, float]
    known_frequency: float
    depth: dict[float, float] = field(default_factory=dict)
    angle: dict[float, float] = field(default_factory=dict)
    off_axis: dict[float, float] = field(default_factory=dict)
    corrected: bool = False
    defects: int | None = None
    sensor: Sensor | None = None

    def content(self) -> dict[str, Any]:
        """The report for JSON: keys are strings, and an infinite resolution is ``None``."""
        plain = asdict(self)
        for name, value in plain.items():
            if isinstance(value, dict):
                plain[name] = {str(key): None if number == float("inf") else number for key, number in value.items()}
        return plain


def inspect_psf(
    calibration: Calibration,
    frame: Frame | None = None,
    *,
    depth: dict[float, Psf] | None = None,
    angle: dict[float, Psf] | None = None,
    off_axis: Sequence[tuple[float, Psf]] = (),
) -> PsfReport:
    """Measure a PSF.

    Args:
        calibration: of the camera.
        frame: the PSF's raw frame, from `FrameFormat.read`; without it there are no levels in the report.
        depth: PSFs of points at other distances, by the distance.
        angle: PSFs of points off the axis, by the angle.
        off_axis: PSFs of points off the axis, each with its displacement in raw pixels.

    Raises:
        PsfError: the PSF is a single pixel.
    """
    psf = calibration.psf.float().cpu()
    if psf.shape[-2:].numel() == 1:
        raise PsfError(
            "The PSF is a single pixel, which has no shape. Give the whole frame: without `--crop`, `--bin`."
        )
    colours = [psf[:, [c]] for c in range(psf.shape[1])]
    pairs = [(a, b) for i, a in enumerate(colours) for b in colours[:i]]
    peak = psf_measures.autocorrelation(psf)
    weak_part, dark_rings = psf_spectrum.spectral_zeros(psf)
    levels = _levels(calibration, frame) if frame is not None else None
    return PsfReport(
        psf_hash=calibration.psf_hash,
        size=calibration.size,
        levels=levels,
        support=psf_measures.support(psf),
        peak_width_px=peak.width,
        bin=calibration.frames.bin,
        coarsest_bin=calibration.frames.bin * psf_measures.coarsest_bin(psf),
        side_lobe=(peak.lobe, peak.lobe_at),
        weak_part=weak_part,
        dark_rings=dark_rings,
        effective_rank=psf_measures.effective_rank(psf),
        colour_likeness=min((psf_measures.likeness(a, b) for a, b in pairs), default=1.0),
        noise_gain={value: max(psf_spectrum.noise_gain(psf, value)) for value in LAMBDAS},
        detail_kept={value: min(psf_spectrum.detail_kept(psf, value)) for value in LAMBDAS},
        resolution_px={noise: _resolution(colours, noise) for noise in NOISES},
        known_frequency=_known_frequency(psf, levels.noise_floor if levels else 0.0),
        depth=_likenesses(psf, (depth or {}).items()),
        angle=_likenesses(psf, (angle or {}).items()),
        off_axis=_likenesses(psf, off_axis),
        corrected=calibration.corrections.psf_done,
        defects=None if calibration.corrections.defects is None else calibration.corrections.count,
        sensor=calibration.sensor,
    )


def _likenesses(psf: Psf, others: Iterable[tuple[float, Psf]]) -> dict[float, float]:
    """Correlation with the PSFs of other points, by their place; the least of those at the same place."""
    found: dict[float, float] = {}
    for place, other in others:
        found[place] = min(psf_measures.likeness(other, psf), found.get(place, math.inf))
    return found


def _resolution(colours: list[Psf], noise: float) -> float:
    """Half the shortest visible period of the worst colour, in pixels."""
    frequency = min(psf_spectrum.resolved_frequency(colour, noise) for colour in colours)
    return 0.5 / frequency if frequency > 0 else float("inf")


def _known_frequency(psf: Psf, floor: float) -> float:
    """Frequency above which the PSF's power stays below twice that of its noise."""
    ring = psf_spectrum.radial_power(psf)
    lost = (ring.power < 2 * floor).flip(0).long().cumprod(0).flip(0).nonzero()
    return float(ring.frequency[lost[0, 0]]) if len(lost) else 0.5


def _levels(calibration: Calibration, frame: Frame) -> Levels:
    psf_format, captures = calibration.psf_format, calibration.frames
    frames = psf_format.own_frames(captures)
    image = calibration.psf_image(frame)
    background = estimate_background(image)
    integers = frame.dtype.kind != "f"
    scale = frames.full_scale(frame)  # of floats: 1, or that of the bit depth by which they are divided, too
    noise = noise_level(image, parts=1)
    if integers:
        # The noise of rounding, step / sqrt(12): the median of an 8-bit frame's differences often misses it.
        noise = noise.clamp(min=1 / (12**0.5 * scale * frames.bin))
    subtracted = torch.tensor(calibration.background or (0.0,) * image.shape[1])[:, None, None]
    light = (image - subtracted).clamp(min=0).sum((-2, -1), keepdim=True).clamp(min=1e-30)
    pixels = image.shape[-2] * image.shape[-1]
    upright = psf_format.turn(image, captures).mean((0, 1))
    share = background.clamp(min=0) * pixels / image.clamp(min=0).sum((-2, -1), keepdim=True).clamp(min=1e-30)
    return Levels(
        integers=integers,
        peak=float(frame.max()) / scale,
        largest=int(frame.max()) if integers else 0,
        saturated=frames.saturated(frame)[0],
        background=tuple(background.flatten().tolist()),
        has_dark=calibration.dark is not None or calibration.corrections.psf_done,
        subtracted=calibration.background,
        pedestal=float(share.max()),
        below_zero=float((image < -BELOW_ZERO_SIGMAS * noise.clamp(min=1e-6 * image.amax())).float().mean()),
        between=psf_measures.level_between_lines(upright[psf_measures.support_box(calibration.psf)]),
        noise=float(noise.max()),
        noise_floor=float((pixels * (noise / light).square()).max()),
        possible_bit_depth=frames.possible_bit_depth(frame),
    )
