"""Pairs of noisy and clean scenes to train a denoiser on, independent of any camera."""

import math
from dataclasses import dataclass

import torch

from mwdn.arguments import checked
from mwdn.data.random import uniform
from mwdn.data.simulated import Batch, Samples, SimulatedPairs, full_precision
from mwdn.errors import ParameterError


@checked
@dataclass(frozen=True)
class Denoising:
    """The [denoising] of a recipe: train a denoiser of scenes instead of a reconstruction.

    Args:
        levels: lowest and highest standard deviation of the noise, relative to the scene's brightest pixel; drawn
            log-uniformly. Zeros for no denoising.
    """

    levels: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.levels != (0.0, 0.0) and not 0 < self.levels[0] <= self.levels[1]:
            raise ParameterError(f"`levels` of [denoising] {self.levels} must rise from above 0: [0.003, 0.15].")


@dataclass(frozen=True, eq=False)
class NoisyScenes(Samples):
    """Pairs of a noisy and a clean scene.

    Args:
        pairs: makes the scenes; its camera and sensor are not used.
        denoising: noise levels.
    """

    pairs: SimulatedPairs
    denoising: Denoising

    @property
    def name(self) -> str:
        """Independent of the photographs, so that a run may resume with more of them."""
        return "noisy scenes"

    @property
    def content(self) -> str:
        """Hash of the photographs."""
        return self.pairs.content

    @full_precision
    def batch(self, numbers: range | list[int]) -> Batch:
        """Simulate the samples of these numbers.

        Returns:
            noisy scene (B, 3, H, W) as the measurement; scene with a brightest pixel of 1; noise level (B, 1, 1, 1) in
            place of the PSF, as a denoiser's second input.
        """
        generators = self.pairs.generators(numbers)
        scene = self.pairs.scenes(generators)
        scene = scene / scene.amax((1, 2, 3), keepdim=True).clamp(min=1e-3)
        lowest, highest = map(math.log, self.denoising.levels)
        level = uniform(generators, lowest, highest).exp()[..., None, None].to(scene)
        noise = torch.stack([torch.randn(scene.shape[1:], generator=generator) for generator in generators])
        return Batch(scene + level * noise.to(scene), scene, level)
