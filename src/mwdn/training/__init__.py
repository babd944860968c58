"""Training: from a recipe to a checkpoint."""

from mwdn.training.losses import Loss
from mwdn.training.recipe import Recipe, Schedule, read_recipe

__all__ = ["Loss", "Recipe", "Schedule", "read_recipe"]
