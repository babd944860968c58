"""How much of a capture's detail is noise."""

from typing import NamedTuple

import torch
from torch.nn import functional as F

from mwdn.calibration import Calibration
from mwdn.diagnosis.verdict import Verdict
from mwdn.optics.noise import noise_level
from mwdn.solvers.alignment import fine_detail
from mwdn.types import Frame, Image, Measurement

JPEG_EDGES = 1.1
"""`block_edges` of JPEG files is above: 1.2 and more at qualities 85 to 95, 1.06 and less without."""

MIN_LEVELS = 16
"""Different numbers in a frame below which rounding hides its detail and its noise."""


class NoiseBounds(NamedTuple):
    """Least and greatest part of a capture's detail that may be noise."""

    low: float
    high: float


def noise_bounds(measurement: Measurement) -> NoiseBounds:
    """Estimate the part of a measurement's detail that is noise.

    White noise is estimated from the finest detail, twice: of single pixels, and of means of 2 x 2, which have half of
    it. Noise that is correlated, by an interpolated mosaic, is smaller in single pixels only, and a sharp capture has
    detail of its own in the means. So the two are bounds. There is no upper bound for JPEG, which removes fine noise
    and leaves its coarse part, and for frames of few levels (dark or saturated ones), whose rounding is not white
    noise.

    Args:
        measurement: (1, C, H, W).
    """
    b = measurement.float() / measurement.abs().amax().clamp(min=1e-30)
    energy = float(fine_detail(b).square().mean((-2, -1)).sum().clamp(min=1e-30))
    single = float(noise_level(b).square().sum())
    pairs = 4 * float(noise_level(F.avg_pool2d(b, 2)).square().sum()) if min(b.shape[-2:]) > 1 else single
    low, high = (min(1.0, variance / energy) for variance in sorted((single, pairs)))
    some = b.flatten()[:: max(1, b.numel() // 100_000)]
    is_unbounded = len(set(some.tolist())) < MIN_LEVELS or block_edges(b) > JPEG_EDGES
    return NoiseBounds(low, 1.0 if is_unbounded else high)


def block_edges(image: Image) -> float:
    """Step between pixels at the borders of JPEG's blocks, relative to the median of the eight places in a block.

    A step is the difference of two neighbours less the mean of the differences beside it. 1 for files without JPEG.
    """
    ratios = []
    for across in (image, image.mT):
        difference = across.diff(dim=-1)
        step = (difference[..., 1:-1] - (difference[..., :-2] + difference[..., 2:]) / 2).abs().mean((0, 1, 2))
        if len(step) < 64:  # too few blocks
            return 1.0
        places = step[: len(step) // 8 * 8].reshape(-1, 8).mean(0)
        ratios.append(places / places.median().clamp(min=1e-30))
    return float(torch.stack(ratios).mean(0).max())


def noise(frame: Frame, calibration: Calibration) -> Verdict:
    """Whether more than half of a capture's detail is noise."""
    low, high = noise_bounds(calibration.correct(frame))
    if low > 0.5:
        text = f"{low:.0%} of the capture's detail is noise. Expose longer or use more light."
        return Verdict("capture", "noise", "doubt", text, "noise")
    if high > 0.5:
        return Verdict("capture", "noise", "unknown", f"Between {low:.0%} and {high:.0%} of the detail is noise.")
    return Verdict("capture", "noise", "good", f"At most {high:.0%} of the capture's detail is noise.")
