"""How fast to learn at each step, on which weights of the loss, by which optimiser, and when to stop."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import nn

from mwdn.training.recipe import Recipe, Schedule

THRESHOLD = 1e-4
"""A validation loss is a new lowest one if it is lower by this part of the lowest so far."""


def learning_rate(step: int, schedule: Schedule) -> float:
    """Linear warm-up, then half a cosine down to 1 % of the highest rate."""
    if step < schedule.warmup:
        return schedule.learning_rate * (step + 1) / schedule.warmup
    progress = (step - schedule.warmup) / max(1, schedule.steps - schedule.warmup)
    return schedule.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))


@dataclass(frozen=True)
class Cosine:
    """Our course: it knows its end from the beginning, and so does not look at the validation."""

    recipe: Recipe
    finished: ClassVar[bool] = False

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        return learning_rate(step, self.recipe.schedule)

    @property
    def weights(self) -> dict[str, float]:
        """Of the parts of the loss."""
        return self.recipe.loss

    def after(self, loss: float) -> "Cosine":
        """The course after a validation: the same."""
        return self

    def state(self) -> dict[str, Any]:
        """What a saved run must remember: nothing, as all follows from the step."""
        return {}


@dataclass(frozen=True)
class Descent:
    """The paper's course: the learning rate falls when the validation loss does not.

    Its phases follow from the learning rate alone. With the paper's numbers, 1e-4 / 1e-5 are the first phase, 1e-6 /
    1e-7 the second, with less weight on features, and the run would end at 1e-8.

    Args:
        recipe: with its `Plateau` and both weightings of the loss.
        current: learning rate.
        best: lowest validation loss so far.
        bad: validations since, at this learning rate.

    References:
        Section 4 of the paper for the two weightings; the numbers are those of the authors' code.
    """

    recipe: Recipe
    current: float
    best: float = math.inf
    bad: int = 0

    def rate(self, step: int) -> float:
        """Learning rate of the next step, whichever it is."""
        return self.current

    @property
    def weights(self) -> dict[str, float]:
        """Of the parts of the loss, in this phase."""
        later = self.recipe.plateau.later
        # Rounding aside: 1e-4 x 0.1 x 0.1 is 1.0000000000000002e-6, and 1e-6 is meant.
        if self.recipe.later_loss and (self.current < later or math.isclose(self.current, later)):
            return self.recipe.later_loss
        return self.recipe.loss

    @property
    def finished(self) -> bool:
        """Whether the learning rate has become too small to go on with."""
        stop = self.recipe.plateau.stop
        return self.current < stop and not math.isclose(self.current, stop)

    def after(self, loss: float) -> "Descent":
        """The course after a validation of this loss, which is weighted as in the first phase."""
        if loss < self.best * (1 - THRESHOLD):
            return Descent(self.recipe, self.current, loss)
        if self.bad < self.recipe.plateau.patience:
            return Descent(self.recipe, self.current, self.best, self.bad + 1)
        return Descent(self.recipe, self.current * self.recipe.plateau.factor, self.best)

    def state(self) -> dict[str, Any]:
        """What a saved run must remember; `begin` takes it back."""
        return {"current": self.current, "best": self.best, "bad": self.bad}


Course = Cosine | Descent


def begin(recipe: Recipe, **state: Any) -> Course:  # noqa: ANN401
    """The course of a recipe, at its beginning or where ``state`` says."""
    if recipe.schedule.course == "cosine":
        return Cosine(recipe)
    return Descent(recipe, **({"current": recipe.schedule.learning_rate} | state))


def optimiser(network: nn.Module, schedule: Schedule) -> torch.optim.Optimizer:
    """Make the optimiser of a schedule.

    ``"adamw"`` pulls convolution weights to zero beside the gradient; biases and BatchNorm stay free. ``"adam"`` adds
    the decay of all parameters to the gradient, as the authors' code does. Neither decays w and lambda (the authors'
    code does: it pulls them to 0, ours, which are logarithms, would go to 1).
    """
    paper = schedule.optimiser == "adam"
    groups: dict[bool, list[nn.Parameter]] = {True: [], False: []}
    for name, parameter in network.named_parameters():
        physical = name.rpartition(".")[2].startswith("log_")  # w and lambda are the logarithms among the parameters
        groups[not physical if paper else parameter.ndim > 1].append(parameter)
    kind = torch.optim.Adam if paper else torch.optim.AdamW
    return kind(
        [
            {"params": parameters, "weight_decay": schedule.weight_decay if decayed else 0.0}
            for decayed, parameters in groups.items()
        ],
        lr=schedule.learning_rate,
    )
