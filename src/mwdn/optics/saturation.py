"""Saturated pixels, whose values are a lower bound of the light."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.types import Measurement

PLATEAU = 0.98, 0.995
"""Fractions of a colour's maximum. A saturated capture has more pixels above the second than between the two; other
captures have many times fewer, because the brightest light is rare."""

MIN_SATURATED = 5e-4
"""Smallest fraction of saturated pixels: fewer are bright peaks or hot pixels."""


def saturated_pixels(measurement: Measurement) -> Tensor:
    """Where a measurement (B, C, H, W) is saturated, bool, found by the plateau at the maximum of each colour.

    The result does not depend on the scale of the measurement, nor on a black level that was subtracted. A capture
    without a plateau, or with fewer than 50 grey levels, has no saturated pixels.
    """
    most = measurement.amax((-2, -1), keepdim=True)
    sample = measurement[..., ::2]
    above, at = ((sample >= part * most).float().mean((-2, -1), keepdim=True) for part in PLATEAU)
    below = above - at
    is_plateau = (at > below) & (below > 0) & (at >= MIN_SATURATED)
    return measurement >= torch.where(is_plateau, PLATEAU[1] * most, torch.inf)


def subtract_light(measurement: Measurement, light: Tensor) -> Measurement:
    """Subtract light (B, C, H, W) from a measurement; its saturated pixels stay a plateau (`keep_plateau`)."""
    return keep_plateau(measurement, measurement - light)


def keep_plateau(saturating: Measurement, corrected: Measurement) -> Measurement:
    """Make the saturated pixels of a corrected measurement a plateau again: a lower bound of their light.

    A flat field or a subtracted frame gives saturated pixels different values. The bound is the least of their maxima
    over 3 x 3 pixels. Two kinds of pixels do not count: those without a saturated neighbour, which may be hot pixels,
    and those that lose more than half, which the subtracted frame alone may have saturated.

    Args:
        saturating: (B, C, H, W), the measurement before the correction.
        corrected: (B, C, H, W).
    """
    saturated = saturated_pixels(saturating)
    together = F.avg_pool2d(saturated.float(), 3, stride=1, padding=1, divisor_override=1) > 1.5
    known = saturated & together & (corrected != saturating) & (corrected > saturating / 2)
    values = F.max_pool2d(torch.where(known, corrected, -torch.inf), 3, stride=1, padding=1)
    return corrected.minimum(torch.where(known, values, torch.inf).amin((-2, -1), keepdim=True))
