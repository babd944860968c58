"""Pairs across cameras: every sample has its own random camera."""

import re
from dataclasses import dataclass, replace

import torch

from mwdn.arguments import checked
from mwdn.data.random import seeded
from mwdn.data.simulated import Batch, Samples, SimulatedPairs, full_precision
from mwdn.errors import ParameterError
from mwdn.optics.random_psf import FAMILIES, sample_camera
from mwdn.types import Size

CAMERA_SEED = 7
"""Separates the generators of the cameras from those of the samples."""


@checked
@dataclass(frozen=True)
class Cameras:
    """The [cameras] of a recipe: learn to reconstruct with any PSF instead of one.

    Args:
        sizes: sensor sizes such as "320x320" (height first), one per batch in turn; empty to train for the given
            camera.
        families: kinds of masks, see `mwdn.optics.FAMILIES`; empty for all of them.
    """

    sizes: tuple[str, ...] = ()
    families: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for text in self.sizes:
            sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text, re.ASCII)
            if not sides or min(map(int, sides.groups())) < 8:
                raise ParameterError(f'`sizes` of [cameras] ("{text}") must be height x width: "270x480".')
        for name in self.families:
            if name not in FAMILIES:
                raise ParameterError(f'`families` of [cameras] ("{name}") must be of {", ".join(FAMILIES)}.')

    def size(self, number: int) -> Size:
        """Sensor size of a batch."""
        height, _, width = self.sizes[number % len(self.sizes)].partition("x")
        return int(height), int(width)


@dataclass(frozen=True, eq=False)
class CameraPairs(Samples):
    """Simulated pairs, each of its own random camera, whose PSF is part of the sample.

    Args:
        pairs: makes the scenes and their measurements; its own PSF is not used.
        cameras: sizes and kinds of the cameras.
        batch_size: consecutive samples that share a sensor size.
    """

    pairs: SimulatedPairs
    cameras: Cameras
    batch_size: int

    @property
    def name(self) -> str:
        """Independent of the photographs, so that a run may resume with more of them."""
        return "simulated across cameras"

    @property
    def content(self) -> str:
        """Hash of the photographs."""
        return self.pairs.content

    @full_precision
    def batch(self, numbers: range | list[int]) -> Batch:
        """Simulate the samples of these numbers, which must belong to one batch."""
        size = self.cameras.size(numbers[0] // self.batch_size)
        device = self.pairs.psf.device
        psfs = []
        for number in numbers:
            generator = seeded(self.pairs.sample_seed(number) ^ (CAMERA_SEED << 24))
            names = self.cameras.families or tuple(FAMILIES)
            family = names[int(torch.randint(len(names), (), generator=generator))]
            psfs.append(sample_camera(generator, size, family=family, device=device))
        psf = torch.cat(psfs)
        return replace(self.pairs, psf=psf).batch(numbers)._replace(psf=psf)
