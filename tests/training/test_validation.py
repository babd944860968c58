"""Validation: its scores by their definition, and the contact sheet."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from mwdn.data.simulated import Batch, Samples
from mwdn.io.contact_sheets import contact_sheet
from mwdn.training.losses import Loss
from mwdn.training.recipe import Recipe, Schedule
from mwdn.training.tasks import SupervisedTask
from mwdn.training.validation import VALIDATION_START, Validator

SIZE = 12, 16
RECIPE = Recipe({"name": "unet"}, Schedule(batch=2, validation=5), {"mse": 1.0, "l1": 0.5})


class Numbered(Samples):
    """Pair n is random with seed n; records the requested numbers."""

    name = "numbered"

    def __init__(self):
        self.asked = []

    def batch(self, numbers):
        self.asked += numbers
        pictures = [torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(n % 1000)) for n in numbers]
        return Batch(*torch.stack(pictures, dim=1), PSF)


class Darker(nn.Module):
    """Its output exceeds [0, 1]: it must be clipped for the PSNR, but not for the loss."""

    def forward(self, measurement, psf):
        return 1.5 * measurement - 0.2


PSF = torch.ones(1, 3, *SIZE) / (SIZE[0] * SIZE[1])


@pytest.mark.parametrize("batch", [1, 2, 5, 9])
def test_means_over_the_samples_whatever_the_batch(batch):
    pairs = Numbered()
    recipe = replace(RECIPE, schedule=replace(RECIPE.schedule, batch=batch))
    loss = Loss(RECIPE.loss)
    loss.weights = {"mse": 1.0, "l1": 0.0}  # of the training's current phase
    result = Validator(recipe, SupervisedTask(pairs), PSF)(Darker(), loss, "step 3")
    assert pairs.asked == list(range(VALIDATION_START, VALIDATION_START + 5))
    measurement, scene, _ = Numbered().batch(pairs.asked)
    error = 1.5 * measurement - 0.2 - scene
    clipped = (1.5 * measurement - 0.2).clamp(0, 1) - scene
    assert result.loss == pytest.approx(float(error.square().mean() + 0.5 * error.abs().mean()), rel=1e-5)
    assert result.psnr == pytest.approx(float((-10 * clipped.square().mean((1, 2, 3)).log10()).mean()), rel=1e-5)
    assert loss.weights == {"mse": 1.0, "l1": 0.0}


@pytest.mark.parametrize("shown", [1, 3, 6, 8])
def test_captures_stand_beside_the_pairs(shown):
    """Five pairs, and at most six captures; white where rows are missing."""
    captures = torch.rand(shown, 3, *SIZE)
    network = Darker()
    sheet = Validator(RECIPE, SupervisedTask(Numbered()), PSF, captures)(network, Loss(RECIPE.loss), "step 3").sheet
    measurement, scene, _ = Numbered().batch(range(VALIDATION_START, VALIDATION_START + 5))
    white = torch.ones(1, 1, *SIZE)
    rows = [[m[None], network(m[None], PSF), s[None]] for m, s in zip(measurement, scene, strict=True)]
    rows += [[white] * 3] * (min(shown, 6) - 5)
    for number, row in enumerate(rows):
        real = captures[number : number + 1]
        row += [real, network(real, PSF)] if number < shown else [white] * 2
    torch.testing.assert_close(sheet, contact_sheet(rows, ["measurement", "step 3", "scene", "capture", "step 3"]))


def test_sheet_without_captures():
    sheet = Validator(RECIPE, SupervisedTask(Numbered()), PSF)(Darker(), Loss(RECIPE.loss), "step 3").sheet
    measurement, scene, _ = Numbered().batch(range(VALIDATION_START, VALIDATION_START + 5))
    rows = [[m[None], 1.5 * m[None] - 0.2, s[None]] for m, s in zip(measurement, scene, strict=True)]
    torch.testing.assert_close(sheet, contact_sheet(rows, ["measurement", "step 3", "scene"]))
