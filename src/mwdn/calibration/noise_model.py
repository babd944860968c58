"""Noise of a linear sensor: variance against signal, from frames of the same light."""

from typing import NamedTuple

import torch
from torch import Tensor

SIGNAL_GROUPS = 24
"""Levels of brightness at which the variance is measured."""

CUT_OFF = 0.1
"""Part of the pixels at the lowest signal from which on the noise is cut off there, as that of raw files at black."""

DARK = 0.8
"""Part of the pixels, the darkest, whose variance is then the least floor: groups of equal signal have none."""


class NoiseModel(NamedTuple):
    """Variance of one frame's pixel: ``slope * signal + floor``, in units of the full scale.

    Args:
        slope: of the shot noise, 1 / full well: an electron is this fraction of the full scale.
        floor: variance without light: read noise and quantisation.
    """

    slope: float
    floor: float

    def variance(self, signal: Tensor) -> Tensor:
        """Variance at each pixel of a signal above black."""
        return self.slope * signal.clamp(min=0) + self.floor


TYPICAL = NoiseModel(1 / 15_000, (3.0 / 15_000) ** 2)
"""The default of `mwdn.optics.Sensor`, for a single frame, whose noise cannot be measured."""


def clipped_variance(values: Tensor) -> float:
    """Variance of numbers around 0 without their outliers, by three rounds of clipping at five standard deviations.

    For integers of a few counts, the median of their absolute values would change in steps; this variance does not.
    """
    square = values.flatten().double().square()
    variance = float(square.mean())
    for _ in range(3):
        kept = square[square <= 25 * variance] if variance > 0 else square
        variance = float(kept.mean()) if len(kept) else 0.0
    return variance


def fit_noise(signal: Tensor, difference: Tensor, *, step: float = 0.0) -> NoiseModel:
    """Fit the noise of one frame to the differences of frames of the same light.

    The pixels are sorted by their signal into `SIGNAL_GROUPS` groups. A line through the variance of each, weighted by
    ``count / variance^2`` (the variance of a variance), has the two numbers of the model.

    Args:
        signal: mean of the frames above black, in units of the full scale, of any shape.
        difference: of two frames, divided by sqrt(2), at the same pixels.
        step: of the quantisation; the floor is at least its variance, step^2 / 12. Where the noise is cut off
            (`CUT_OFF`), it is at least the variance of the dark pixels.
    """
    order = signal.flatten().argsort()
    mean, spread = signal.flatten()[order], difference.flatten()[order]
    parts = [part for part in torch.arange(len(order)).tensor_split(SIGNAL_GROUPS) if len(part) > 8]
    levels = torch.tensor([float(mean[part].double().mean()) for part in parts], dtype=torch.float64)
    variances = torch.tensor([clipped_variance(spread[part]) for part in parts], dtype=torch.float64)
    least = max(step**2 / 12, 1e-16)
    if len(mean) and float((mean == mean[0]).float().mean()) > CUT_OFF:
        least = max(least, clipped_variance(spread[: int(DARK * len(spread))]))
    variances = variances.clamp(min=least)
    slope, floor = fit_line(levels, variances, 1 / variances.square())
    return NoiseModel(max(slope, 0.0), max(floor, least))


def fit_line(x: Tensor, y: Tensor, weight: Tensor) -> tuple[float, float]:
    """Slope and intercept of a weighted straight line; a slope of 0 if all x are equal."""
    total = weight.sum()
    centre, height = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * (x - centre).square()).sum()
    slope = float((weight * (x - centre) * (y - height)).sum() / spread) if float(spread) > 0 else 0.0
    return slope, float(height) - slope * float(centre)
