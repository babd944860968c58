"""Pairs across cameras: every sample through a camera of its own, none twice."""

from dataclasses import dataclass, replace

import torch

from mwdn.data.random import seeded
from mwdn.data.simulated import Pair, SimulatedPairs, full_precision
from mwdn.errors import ParameterError
from mwdn.optics.random_psf import FAMILIES, sample_camera
from mwdn.types import Size

CAMERA_SEED = 7
"""Apart from the generators of the samples themselves."""


@dataclass(frozen=True)
class Cameras:
    """The [cameras] of a recipe: learn to reconstruct with any PSF, not with one.

    Args:
        sizes: of the sensors, such as "320x320" (height first), one drawn for each batch; empty for one camera only.
        families: kinds of masks, see `mwdn.optics.FAMILIES`; all of them unless named.
    """

    sizes: tuple[str, ...] = ()
    families: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for text in self.sizes:
            height, _, width = text.partition("x")
            if not (height.isdigit() and width.isdigit() and min(int(height), int(width)) >= 8):
                raise ParameterError(f'`sizes` of [cameras] ("{text}") must be height x width: "270x480".')
        for name in self.families:
            if name not in FAMILIES:
                raise ParameterError(f'`families` of [cameras] ("{name}") must be of {", ".join(FAMILIES)}.')

    def size(self, number: int) -> Size:
        """Size of the sensor of a batch."""
        height, _, width = self.sizes[number % len(self.sizes)].partition("x")
        return int(height), int(width)


@dataclass(frozen=True, eq=False)
class CameraPairs:
    """A source of pairs, each through a random camera, which the network is told the PSF of.

    Args:
        pairs: how scenes are made and captured; its own PSF is not used.
        cameras: what they are like.
        together: samples in a row that have the same size: a batch.
    """

    pairs: SimulatedPairs
    cameras: Cameras
    together: int

    @property
    def name(self) -> str:
        """The same for all photographs."""
        return "simulated across cameras"

    @full_precision
    def batch(self, numbers: range | list[int]) -> Pair:
        """Make the samples of these numbers, which must lie in one batch."""
        size = self.cameras.size(numbers[0] // self.together)
        device = self.pairs.psf.device
        psfs = []
        for number in numbers:
            generator = seeded((self.pairs.seed * 1_000_003 + number) ^ (CAMERA_SEED << 24))
            names = self.cameras.families or tuple(FAMILIES)
            family = names[int(torch.randint(len(names), (), generator=generator))]
            psfs.append(sample_camera(generator, size, family=family, device=device))
        psf = torch.cat(psfs)
        return replace(self.pairs, psf=psf).batch(numbers)._replace(psf=psf)
