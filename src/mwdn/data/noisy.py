"""Noisy pictures and clean ones: what a denoiser learns from, whatever the camera."""

import math
from dataclasses import dataclass

import torch

from mwdn.data.random import uniform
from mwdn.data.simulated import Pair, SimulatedPairs, full_precision
from mwdn.errors import ParameterError


@dataclass(frozen=True)
class Denoising:
    """The [denoising] of a recipe: learn to take noise out of scenes, not to reconstruct.

    Args:
        levels: lowest and highest standard deviation of the noise, over the scene's brightest pixel; each factor
            between them is as likely. Zeros for no denoising.
    """

    levels: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.levels != (0.0, 0.0) and not 0 < self.levels[0] <= self.levels[1]:
            raise ParameterError(f"`levels` of [denoising] {self.levels} must rise from above 0: [0.003, 0.15].")


@dataclass(frozen=True, eq=False)
class NoisyScenes:
    """A source of pairs without a camera.

    Args:
        pairs: how scenes are made; camera and sensor are not used.
        denoising: how noisy they are.
    """

    pairs: SimulatedPairs
    denoising: Denoising

    @property
    def name(self) -> str:
        """The same for all photographs."""
        return "noisy scenes"

    @full_precision
    def batch(self, numbers: range | list[int]) -> Pair:
        """Make the samples of these numbers.

        Returns:
            the noisy scene (B, 3, H, W); the scene, its brightest pixel 1; in place of a PSF the noise level
            (B, 1, 1, 1).
        """
        generators = self.pairs.generators(numbers)
        scene = self.pairs.scenes(generators)
        scene = scene / scene.amax((1, 2, 3), keepdim=True).clamp(min=1e-3)
        lowest, highest = map(math.log, self.denoising.levels)
        level = uniform(generators, lowest, highest).exp()[..., None, None].to(scene)
        noise = torch.stack([torch.randn(scene.shape[1:], generator=generator) for generator in generators])
        return Pair(scene + level * noise.to(scene), scene, level)
