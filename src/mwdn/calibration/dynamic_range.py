"""Merge frames of several exposures to one picture of high dynamic range."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.calibration.frame_average import FrameAverage
from mwdn.calibration.noise_model import TYPICAL, NoiseModel
from mwdn.errors import ParameterError
from mwdn.types import Image

MAX_EXPOSURES = 8
"""Largest number of exposures."""

CEILING = 0.92
"""Level above which a pixel of an exposure is not used: near saturation sensors are no longer linear."""

WORST_RATIO = 1.5
"""Largest factor between the given ratio of exposures and the measured one; beyond it they do not match."""


class Merged(NamedTuple):
    """A picture of high dynamic range.

    Args:
        image: (1, C, H, W), light in units of the shortest exposure's full scale.
        exposures: relative to the shortest, as measured in the pixels that neighbouring exposures share.
        noise: (1, C, H, W), standard deviation at each pixel.
    """

    image: Image
    exposures: tuple[float, ...]
    noise: Image


def merge_exposures(averages: Sequence[FrameAverage], exposures: Sequence[float]) -> Merged:
    """Merge averages of frames, from the shortest exposure to the longest.

    Light r gives the signal ``r t`` at the exposure t, whose mean over n frames has the variance
    ``v = (slope r t + floor) / n``. The best estimate of r weights each ``signal / t`` by ``w = t^2 / v`` and leaves
    saturated pixels out. The weights are computed from the merged light, not from the noisy signal of one exposure: a
    signal that is too low by chance would get too high a weight, and the mean would be too low.

    Cameras round exposure times. Their ratios are measured in the pixels that neighbouring exposures share.

    Args:
        averages: of each exposure, dark frames subtracted.
        exposures: their times in any unit.

    Raises:
        ParameterError: the numbers of exposures and averages differ, an exposure is repeated or not positive, or frames
            do not have the light of their exposure.
    """
    if len(averages) != len(exposures) or not 1 <= len(exposures) <= MAX_EXPOSURES:
        raise ParameterError(
            f"`exposures` ({len(exposures)}) must be 1 to {MAX_EXPOSURES}, one for each of {len(averages)}."
        )
    if min(exposures) <= 0 or len(set(exposures)) < len(exposures):
        raise ParameterError(f"`exposures` ({', '.join(f'{t:g}' for t in exposures)}) must be positive and differ.")
    order = sorted(range(len(exposures)), key=lambda number: exposures[number])
    averages = [averages[number] for number in order]
    nominal = [exposures[number] / exposures[order[0]] for number in order]
    models = [average.noise or TYPICAL for average in averages]
    usable = [(average.image < CEILING) & ~average.saturated for average in averages]
    times = _measured(averages, usable, nominal, models)
    light = averages[0].image
    for _ in range(3):  # the weights change by less than 1 % after the second round
        light, weight = _weighted(averages, usable, times, models, light)
    single = (models[0].variance(light) / averages[0].count).sqrt()
    return Merged(light, tuple(times), torch.where(weight > 0, weight.clamp(min=1e-30).rsqrt(), single))


def _weighted(
    averages: Sequence[FrameAverage],
    usable: Sequence[Tensor],
    times: Sequence[float],
    models: Sequence[NoiseModel],
    light: Image,
) -> tuple[Image, Tensor]:
    """Weighted mean of the exposures, and the sum of the weights; the shortest exposure where none is usable."""
    total, weights = torch.zeros_like(light), torch.zeros_like(light)
    for average, good, t, model in zip(averages, usable, times, models, strict=True):
        weight = good * t**2 * average.count / model.variance(light * t)
        total, weights = total + weight * average.image / t, weights + weight
    return torch.where(weights > 0, total / weights.clamp(min=1e-30), averages[0].image), weights


def _measured(
    averages: Sequence[FrameAverage], usable: Sequence[Tensor], nominal: Sequence[float], models: Sequence[NoiseModel]
) -> list[float]:
    """Exposures relative to the shortest, from the light of the pixels that neighbours share."""
    times = [1.0]
    for number in range(1, len(averages)):
        shorter, longer = averages[number - 1], averages[number]
        given = nominal[number] / nominal[number - 1]
        # Pixels well above the noise of the shorter exposure, selected in the longer one to avoid a selection bias.
        clear = longer.image > given * 3 * (models[number - 1].floor / shorter.count) ** 0.5
        shared = usable[number] & usable[number - 1] & clear
        least, most = float(shorter.image[shared].sum()), float(longer.image[shared].sum())
        if int(shared.sum()) < 100 or least <= 0:
            times.append(times[-1] * given)
            continue
        ratio = most / least
        if not 1 / WORST_RATIO < ratio / given < WORST_RATIO:
            raise ParameterError(
                f"`exposures`: the frames at {nominal[number]:g} times the shortest exposure have {ratio:.3g} times "
                f"the light of those at {nominal[number - 1]:g} times, not {given:.3g} times. Give the exposures in "
                "the order of the frames, and take dark frames."
            )
        times.append(times[-1] * ratio)
    return times
