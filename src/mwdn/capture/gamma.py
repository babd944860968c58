"""The gamma of a display, measured with grey steps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mwdn.errors import DisplayError

LOWEST, HIGHEST = 1.0, 4.0
"""Gammas that a display can have."""


class Gamma(NamedTuple):
    """A fit of the light L of coded numbers v in [0, 1]: ``(L - L(0)) / (L(1) - L(0)) = v^gamma``.

    Args:
        gamma: 2.2 for most displays.
        error: largest difference of a step from the fit, over the light of white.
    """

    gamma: float
    error: float


def fit_gamma(levels: Sequence[int], light: Sequence[float]) -> Gamma:
    """Fit a gamma to grey steps.

    Least squares of ``log y = gamma log v``, each step weighted with y^2: the noise of y is constant, so the noise of
    its logarithm falls as 1 / y.

    Args:
        levels: coded numbers, the first 0 and the last 255.
        light: mean of a frame of each, of any scale and offset.

    Raises:
        DisplayError: the light does not follow the steps.
    """
    v, y = np.array(levels) / 255, np.array(light, float)
    contrast = y[-1] - y[0]
    y = (y - y[0]) / contrast if contrast > 0 else y * np.nan
    inner = slice(1, -1)
    if not (y[inner] > 0).all():
        raise DisplayError(
            f"The camera does not see the display get brighter: frames of grey {levels[0]} to {levels[-1]} have means "
            f"from {min(light):.4g} to {max(light):.4g}. Turn the camera to the display, and automatic exposure off."
        )
    weights = y[inner] ** 2
    logarithms = np.log(v[inner])
    gamma = float((weights * logarithms * np.log(y[inner])).sum() / (weights * logarithms**2).sum())
    if not LOWEST <= gamma <= HIGHEST:
        raise DisplayError(
            f"The display's gamma ({gamma:.2f}) must be from {LOWEST:g} to {HIGHEST:g}. Switch automatic exposure, "
            "dynamic contrast and night light off."
        )
    return Gamma(gamma, float(np.abs(y - v**gamma).max()))
