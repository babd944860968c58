"""Validation: scores on samples that the network does not learn from, and a contact sheet."""

from dataclasses import dataclass
from itertools import zip_longest

import torch
from torch import Tensor, nn

from mwdn.io.contact_sheets import contact_sheet
from mwdn.training.losses import Loss
from mwdn.training.recipe import Recipe
from mwdn.training.tasks import Task, reconstruct_aligned
from mwdn.types import Image, Measurement, Psf, size_of

VALIDATION_START = 10**12
"""Number of the first validation sample, far above those of any training."""

SHEET_ROWS = 6
"""Rows of a contact sheet."""


@dataclass(frozen=True, eq=False)
class Validation:
    """Result of a validation.

    Args:
        psnr: mean over the samples, in dB, of reconstructions clipped to [0, 1].
        loss: mean over the samples.
        sheet: (1, 3, H, W), linear light; on the first process only.
    """

    psnr: float
    loss: float
    sheet: Image | None = None


@dataclass(frozen=True, eq=False)
class Validator:
    """Validates a network, always on the same samples.

    The PSF is aligned to each capture if the network is used with an aligned one (``network.align``).

    Args:
        recipe: has the number of samples and the batch size.
        task: scores the samples.
        psf: of the calibration, for the captures.
        captures: (B, C, H, W), real ones, whose reconstructions are shown only: they have no scene.
    """

    recipe: Recipe
    task: Task
    psf: Psf
    captures: Measurement | None = None

    @torch.no_grad()
    def __call__(self, network: nn.Module, distance: Loss, title: str) -> Validation:
        """Validate a network that is on the device of the samples, in evaluation mode.

        Args:
            network: measurement and PSF in, scene out.
            distance: the training's loss.
            title: of the reconstructions on the sheet.
        """
        schedule, psnrs, losses = self.recipe.schedule, [], []
        rows: list[list[Tensor]] = []
        for start in range(0, schedule.validation, schedule.batch):
            end = min(start + schedule.batch, schedule.validation)
            numbers = range(VALIDATION_START + start, VALIDATION_START + end)
            scores = self.task.score(network, distance, numbers)
            psnrs.append(scores.psnr)
            losses.append(len(numbers) * scores.loss)
            rows += _rows(*(pictures[: SHEET_ROWS - len(rows)] for pictures in scores.pictures))
        left, right = self.task.columns
        sheet = _sheet(rows, self.reconstruct_captures(network), (left, title, right), self.psf)
        return Validation(float(torch.cat(psnrs).mean()), sum(losses) / schedule.validation, sheet)

    @torch.no_grad()
    def reconstruct_captures(self, network: nn.Module) -> list[list[Tensor]]:
        """The first six captures with their reconstructions, one at a time: they may be more than a batch."""
        if self.captures is None:
            return []
        rows = []
        for capture in self.captures[:SHEET_ROWS, None]:
            rows += _rows(capture, reconstruct_aligned(network, capture, self.psf))
        return rows


def _rows(*pictures: Tensor) -> list[list[Tensor]]:
    return [[picture[None].cpu() for picture in row] for row in zip(*pictures, strict=True)]


def _sheet(samples: list[list[Tensor]], captures: list[list[Tensor]], titles: tuple[str, str, str], psf: Psf) -> Image:
    """Samples on the left, captures if any on the right; white where one has fewer rows than the other."""
    if not captures:
        return contact_sheet(samples, list(titles))
    blank = torch.ones(1, 1, *size_of(psf))
    rows = [[*(sample or 3 * [blank]), *(capture or 2 * [blank])] for sample, capture in zip_longest(samples, captures)]
    return contact_sheet(rows, [*titles, "capture", titles[1]])
