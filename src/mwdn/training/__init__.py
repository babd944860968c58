"""Training: from a recipe to a checkpoint."""

from mwdn.training.losses import Loss
from mwdn.training.recipe import Recipe, read_recipe

__all__ = ["Loss", "Recipe", "read_recipe"]
