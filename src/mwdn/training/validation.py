"""What a network is worth so far: numbers on pairs that it does not learn from, and a sheet to look at."""

from dataclasses import dataclass
from itertools import zip_longest
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from mwdn.data.simulated import Samples
from mwdn.io.contact_sheets import contact_sheet
from mwdn.networks import Network
from mwdn.solvers import align
from mwdn.training.losses import Loss
from mwdn.training.recipe import Recipe
from mwdn.types import Image, Measurement, Psf, Scene

START = 10**12
"""Samples are numbered; those of the validation start here, where no training ever arrives."""

SHOWN = 6
"""Rows of a sheet."""


@dataclass(frozen=True, eq=False)
class Validation:
    """What was found.

    Args:
        psnr: mean over the samples, in dB, of reconstructions clipped to [0, 1].
        loss: mean over the samples, with the weights of [loss], whichever the training is at.
        sheet: (1, 3, H, W), linear light; on the first process alone.
    """

    psnr: float
    loss: float
    sheet: Image | None = None


class Judged(NamedTuple):
    """What was found on a batch: a PSNR of each sample, the loss, and pictures to be shown."""

    psnr: Tensor
    loss: float
    pictures: tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class Validator:
    """Validates a network, on the same samples each time.

    Args:
        recipe: says how many samples, how many at once, and how the loss is weighted.
        pairs: where they come from.
        psf: of the calibration.
        captures: (B, C, H, W), real ones, whose reconstructions are shown and not measured: no scene is known.
    """

    recipe: Recipe
    pairs: Samples
    psf: Psf
    captures: Measurement | None = None

    columns: ClassVar[tuple[str, str]] = "measurement", "scene"
    """Titles on the sheet, left and right of the reconstruction's."""

    @torch.no_grad()
    def __call__(self, network: nn.Module, loss: Loss, title: str) -> Validation:
        """Validate a network that is on the device of the pairs, in evaluation mode.

        Args:
            network: measurement and PSF in, scene out.
            loss: made of the parts of the recipe's, weighted in any way.
            title: of the reconstructions on the sheet.
        """
        schedule, psnrs, losses = self.recipe.schedule, [], []
        rows: list[list[Tensor]] = []
        for start in range(0, schedule.validation, schedule.batch):
            numbers = range(START + start, START + min(start + schedule.batch, schedule.validation))
            judged = self.judged(network, loss, numbers)
            psnrs.append(judged.psnr)
            losses.append(len(numbers) * judged.loss)
            rows += _rows(*(pictures[: SHOWN - len(rows)] for pictures in judged.pictures))
        columns = [rows, *([self.captured(network)] if self.captures is not None else [])]
        sheet = _sheet(columns, (self.columns[0], title, self.columns[1]), self.psf)
        return Validation(float(torch.cat(psnrs).mean()), sum(losses) / schedule.validation, sheet)

    def judged(self, network: nn.Module, loss: Loss, numbers: range) -> Judged:
        """Compare reconstructions of the pairs of these numbers with their scenes."""
        measurement, scene, psf = self.pairs.batch(numbers)
        found = reconstruct(network, measurement, self.psf if psf is None else psf)
        psnr = -10 * torch.log10((found.clamp(0, 1) - scene).square().mean((1, 2, 3)))
        parts = loss(found, scene)[1]
        weighted = sum(weight * parts[name].item() for name, weight in self.recipe.loss.items())
        return Judged(psnr, weighted, (measurement, found, scene))

    @torch.no_grad()
    def captured(self, network: nn.Module) -> list[list[Tensor]]:
        """The first six captures and their reconstructions, one after the other: they may be more than a batch."""
        captures = [] if self.captures is None else [one[None] for one in self.captures[:SHOWN]]
        return [row for capture in captures for row in _rows(capture, reconstruct(network, capture, self.psf))]


def reconstruct(network: nn.Module, measurement: Measurement, psf: Psf) -> Scene:
    """Reconstruct as `mwdn.Reconstructor` does: with the PSF aligned to each capture, if the network is used so."""
    if isinstance(network, Network) and network.align:
        psf = align(measurement, psf).move(psf)
    return network(measurement, psf)


def _rows(*pictures: Tensor) -> list[list[Tensor]]:
    return [[picture[None].cpu() for picture in row] for row in zip(*pictures, strict=True)]


def _sheet(columns: list[list[list[Tensor]]], heads: tuple[str, str, str], psf: Psf) -> Image:
    """Pairs on the left, captures on the right; white where one has fewer than the other."""
    titles = [*heads, *(["capture", heads[1]] if len(columns) > 1 else [])]
    white = torch.ones(1, 1, *psf.shape[-2:])
    blanks = [[white] * len(column[0]) for column in columns]
    lines = [
        [picture for row, blank in zip(line, blanks, strict=True) for picture in row or blank]
        for line in zip_longest(*columns)
    ]
    return contact_sheet(lines, titles)
