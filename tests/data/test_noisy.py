"""Noisy scenes: the noise is what their level says, and the same number is the same pair."""

import math

import cv2
import numpy as np
import pytest
import torch

from mwdn.data.noisy import Denoising, NoisyScenes
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import Placement, SimulatedPairs
from mwdn.errors import ParameterError


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    smooth = np.random.default_rng(1).integers(30, 256, (3, 3, 3), np.uint8)
    cv2.imwrite(str(folder / "0.png"), cv2.resize(smooth, (24, 24), interpolation=cv2.INTER_CUBIC))
    source = SimulatedPairs(Photographs(folder, side=24), torch.ones(1, 3, 48, 64), placement=Placement())
    return NoisyScenes(source, Denoising((0.003, 0.15)))


def test_noise_is_white_gaussian_of_its_level(pairs):
    noisy, scene, level = pairs.batch(range(8))
    assert noisy.shape == scene.shape == (8, 3, 48, 64)
    noise = (noisy - scene) / level
    assert noise.mean().abs() < 4 / math.sqrt(noise.numel())
    torch.testing.assert_close(noise.std((1, 2, 3)), torch.ones(8), rtol=0, atol=0.04)
    neighbours = (noise[..., 1:] * noise[..., :-1]).mean()
    assert neighbours.abs() < 4 / math.sqrt(noise.numel())


def test_scenes_are_as_bright_as_can_be(pairs):
    scene = pairs.batch(range(8)).scene
    torch.testing.assert_close(scene.amax((1, 2, 3)), torch.ones(8))
    assert scene.min() >= 0


def test_levels_are_even_in_factors(pairs):
    levels = pairs.batch(range(200)).psf.flatten().log()
    lowest, highest = math.log(0.003), math.log(0.15)
    assert lowest <= levels.min() and levels.max() <= highest  # noqa: PT018
    expected = (highest - lowest) / math.sqrt(12 * 200)
    assert (levels.mean() - (lowest + highest) / 2).abs() < 4 * expected


def test_a_number_is_the_same_pair(pairs):
    for alone, together in zip(pairs.batch([5]), pairs.batch([3, 5]), strict=True):
        torch.testing.assert_close(alone[0], together[1])


@pytest.mark.parametrize("levels", [(0.0, 0.1), (0.2, 0.1), (-0.1, 0.1)])
def test_impossible_levels_are_refused(levels):
    with pytest.raises(ParameterError, match=r"`levels` of \[denoising\] .* must rise from above 0"):
        Denoising(levels)
