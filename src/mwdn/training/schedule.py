"""Learning rate, weights of the loss and end of a training, step by step; and its optimiser."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import nn

from mwdn.training.recipe import Recipe, Schedule

THRESHOLD = 1e-4
"""A validation loss counts as an improvement if it is lower than the lowest so far by this relative amount."""


def learning_rate(step: int, schedule: Schedule) -> float:
    """Linear warm-up, then half a cosine down to 1 % of the highest rate; or that rate, if it is "constant"."""
    if step < schedule.warmup:
        return schedule.learning_rate * (step + 1) / schedule.warmup
    if schedule.lr_schedule == "constant":
        return schedule.learning_rate
    progress = (step - schedule.warmup) / max(1, schedule.steps - schedule.warmup)
    return schedule.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))


@dataclass(frozen=True)
class FixedSchedule:
    """Cosine or constant schedule, fixed in advance: it does not depend on the validation."""

    recipe: Recipe
    finished: ClassVar[bool] = False

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        return learning_rate(step, self.recipe.schedule)

    @property
    def loss_weights(self) -> dict[str, float]:
        """Weights of the parts of the loss."""
        return self.recipe.loss

    def after(self, loss: float) -> "FixedSchedule":
        """The schedule after a validation with this loss: unchanged."""
        return self

    def state(self) -> dict[str, Any]:
        """State to save: nothing, because everything follows from the step."""
        return {}


@dataclass(frozen=True)
class ReduceLROnPlateau:
    """The paper's schedule: the learning rate is reduced when the validation loss stops falling.

    The learning rate alone determines the phase. With the paper's numbers 1e-4 and 1e-5 are the first phase, 1e-6 and
    1e-7 the second, with less weight on features, and the run would end at 1e-8.

    Args:
        recipe: with its `Plateau` and both weightings of the loss.
        current: learning rate.
        best: lowest validation loss so far.
        bad: validations since then, at this learning rate.

    References:
        Section 4 of the paper for the two weightings; the numbers are those of the authors' code. The rule is that of
        `torch.optim.lr_scheduler.ReduceLROnPlateau`.
    """

    recipe: Recipe
    current: float
    best: float = math.inf
    bad: int = 0

    def rate(self, step: int) -> float:
        """Learning rate of the next step, whatever its number."""
        return self.current

    @property
    def loss_weights(self) -> dict[str, float]:
        """Weights of the parts of the loss in the current phase."""
        later = self.recipe.plateau.later
        # isclose, because of rounding: 1e-4 x 0.1 x 0.1 is 1.0000000000000002e-6, and 1e-6 is meant.
        if self.recipe.later_loss and (self.current < later or math.isclose(self.current, later)):
            return self.recipe.later_loss
        return self.recipe.loss

    @property
    def finished(self) -> bool:
        """Whether the learning rate has fallen below the limit at which the run ends."""
        stop = self.recipe.plateau.stop
        return self.current < stop and not math.isclose(self.current, stop)

    def after(self, loss: float) -> "ReduceLROnPlateau":
        """The schedule after a validation with this loss, computed with the weights of the first phase."""
        if loss < self.best * (1 - THRESHOLD):
            return ReduceLROnPlateau(self.recipe, self.current, loss)
        if self.bad < self.recipe.plateau.patience:
            return ReduceLROnPlateau(self.recipe, self.current, self.best, self.bad + 1)
        return ReduceLROnPlateau(self.recipe, self.current * self.recipe.plateau.factor, self.best)

    def state(self) -> dict[str, Any]:
        """State to save, for `make_lr_schedule`."""
        return {"current": self.current, "best": self.best, "bad": self.bad}


LRSchedule = FixedSchedule | ReduceLROnPlateau


def make_lr_schedule(recipe: Recipe, **state: Any) -> LRSchedule:  # noqa: ANN401
    """The learning rate schedule of a recipe, at its beginning or in a saved ``state``."""
    if recipe.schedule.lr_schedule != "plateau":
        return FixedSchedule(recipe)
    return ReduceLROnPlateau(recipe, **({"current": recipe.schedule.learning_rate} | state))


def make_optimiser(network: nn.Module, schedule: Schedule) -> torch.optim.Optimizer:
    """The optimiser of a schedule.

    ``"adamw"`` decays convolution weights, apart from the gradient; biases and BatchNorm are not decayed. ``"adam"``
    adds the decay of all parameters to the gradient, as the authors' code does. Neither decays the Wiener filters' w
    and lambda. The authors' code does, which pulls them to 0; here their logarithms are learned, and decay would pull
    w and lambda to 1. Their learning rate is ``filter_rate`` times that of the other parameters (`set_rate`).
    """
    paper = schedule.optimiser == "adam"
    groups: dict[tuple[bool, bool], list[nn.Parameter]] = {}
    for name, parameter in network.named_parameters():
        of_filter = name.rpartition(".")[2].startswith("log_")  # log w and log lambda
        decayed = not of_filter if paper else parameter.ndim > 1
        groups.setdefault((decayed, of_filter), []).append(parameter)
    kind = torch.optim.Adam if paper else torch.optim.AdamW
    optimiser = kind(
        [
            {
                "params": parameters,
                "weight_decay": schedule.weight_decay if decayed else 0.0,
                "rate": schedule.filter_rate if of_filter else 1.0,
            }
            for (decayed, of_filter), parameters in groups.items()
        ]
    )
    set_rate(optimiser, schedule.learning_rate)
    return optimiser


def set_rate(optimiser: torch.optim.Optimizer, learning_rate: float) -> None:
    """Set the learning rate of each group: its ``rate`` times this one."""
    for group in optimiser.param_groups:
        group["lr"] = group["rate"] * learning_rate
