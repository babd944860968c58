"""Exposure of a frame: peak level, saturation, and the exposure to use next."""

import math
from typing import NamedTuple

import numpy as np

from mwdn.calibration.frame_format import FrameFormat
from mwdn.io.arrays import as_frame
from mwdn.types import Frame

TARGET = 0.8
"""Peak of a well exposed PSF, as a fraction of saturation: sensors are linear up to there, with room for drift."""

ABOVE_PEAK = 1e-4
"""Fraction of the pixels above the peak level: 10 of 320 x 320. Hot pixels and cosmic hits are fewer than these."""

WELL_EXPOSED = (0.5, 0.95)
"""Peaks, as fractions of saturation, for which no other exposure is advised."""

MAX_STEP = 16.0
"""Largest advised change of the exposure, as a factor: an estimate from a black or white frame is coarse."""


class Exposure(NamedTuple):
    """How a frame of a point source is exposed.

    Args:
        peak: level above which `ABOVE_PEAK` of the pixels lie, as a fraction of saturation.
        saturated: number of saturated pixels.
        pixels: number of pixels.
        factor: by which to multiply the exposure, so that the peak reaches `TARGET`.
    """

    peak: float
    saturated: int
    pixels: int
    factor: float

    @property
    def is_good(self) -> bool:
        """Whether the peak is within `WELL_EXPOSED` and not cut off."""
        return WELL_EXPOSED[0] <= self.peak <= WELL_EXPOSED[1]

    def next(self, exposure_ms: float | None) -> str:
        """The exposure to use next, in words: the time if this frame's is known, otherwise the factor."""
        if exposure_ms is None:
            return f"{self.factor:.2g} times this exposure"
        return f"{self.factor * exposure_ms:.3g} ms instead of {exposure_ms:g} ms"


def measure_exposure(frame: Frame, frames: FrameFormat = FrameFormat(), *, black: float = 0.0) -> Exposure:
    """Measure how a frame of a point source is exposed.

    Light above saturation is not in the frame. Its peak is extrapolated from the levels below: the number of pixels
    above a level falls about exponentially with the level.

    Args:
        frame: (H, W, C), as stored.
        frames: its format.
        black: mean level of a dark frame, as a fraction of saturation; only light above it grows with the exposure.

    Raises:
        ParameterError: the frame holds numbers above its bit depth.
    """
    frame = as_frame(frame, finite=False)
    saturated, maximum = frames.saturated(frame)
    full = float(maximum) if saturated else frames.full_scale(frame)
    # In a gamma-coded file, the exposure scales the decoded light.
    brightest = np.sort(frames.normalise(frame).amax((0, 1)).flatten().numpy())[::-1]
    levels = brightest * np.float32(frames.full_scale(frame) / full)
    place = min(math.ceil(ABOVE_PEAK * levels.size), levels.size - 1)
    peak = float(levels[place])
    true_peak = _extrapolated(levels, saturated) if saturated > place else peak
    factor = (TARGET - black) / max(true_peak - black, 1e-6)
    return Exposure(peak, saturated, levels.size, float(np.clip(factor, 1 / MAX_STEP, MAX_STEP)))


def _extrapolated(levels: np.ndarray, saturated: int) -> float:
    """Peak that the brightest pixels would reach without saturation, from the slope of the levels below."""
    count, pixels = saturated, levels.size
    if 4 * count >= pixels:
        return MAX_STEP
    # n(level) = n0 exp(-level / width): between the n-th and the 4 n-th pixel lies width * log(4).
    width = (1.0 - float(levels[4 * count])) / math.log(4)
    return 1.0 + width * math.log(count / max(ABOVE_PEAK * pixels, 1.0))
