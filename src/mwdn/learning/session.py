"""A training run from what a user has: a recipe, a calibration, a folder of photographs."""

from dataclasses import replace
from pathlib import Path

import torch

from mwdn.calibration import Calibration
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import SimulatedPairs
from mwdn.learning.recipe import Recipe
from mwdn.learning.train import Trainer

HELD_OUT = 20
"""Every 20th photograph is for validation."""


def prepare(recipe: Recipe, calibration: Calibration, photos: Path, out: Path, device: str | None = None) -> Trainer:
    """Read the photographs and set the run up.

    Args:
        recipe: the experiment.
        calibration: of the camera.
        photos: folder of photographs; every 20th is held out for validation.
        out: folder of the run.
        device: a GPU if there is one unless given.

    Raises:
        MwdnError: a photograph cannot be read, or the folder holds another run.
    """
    place = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    training, validation = Photographs(photos).to(place).split(HELD_OUT)
    pairs = SimulatedPairs(
        training,
        calibration.psf.to(place),
        placement=recipe.placement,
        mismatch=recipe.mismatch,
        sensor=recipe.sensor,
        seed=recipe.schedule.seed,
    )
    return Trainer(recipe, calibration, pairs, out, validation=replace(pairs, photographs=validation), device=place)
