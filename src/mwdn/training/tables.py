"""Small tables of a recipe: the plateau schedule, and the captures of the contact sheet."""

from dataclasses import dataclass

from mwdn.arguments import check_not_negative, checked
from mwdn.errors import ParameterError


@checked
@dataclass(frozen=True)
class Plateau:
    """The [plateau] of a recipe: reduce the learning rate when the validation loss stops falling.

    Defaults are the paper's. The validation loss always has the weights of [loss].

    Args:
        factor: multiplies the learning rate at each reduction.
        patience: validations without a new lowest loss that are tolerated; the next one reduces the learning rate.
        later: from this learning rate down, the loss has the weights of [later_loss]. The authors' code says 1e-6 and
            begins at 1e-7, because 1e-4 x 0.1 x 0.1 is rounded up: `later = 1e-7`.
        stop: the run ends below this learning rate.
    """

    factor: float = 0.1
    patience: int = 5
    later: float = 1e-6
    stop: float = 2e-8

    def __post_init__(self) -> None:
        if not 0 < self.factor < 1:
            raise ParameterError(f"`factor` ({self.factor}) must be in (0, 1): it reduces the learning rate.")
        check_not_negative(patience=self.patience, later=self.later, stop=self.stop)


@dataclass(frozen=True)
class Sheet:
    """The [sheet] of a recipe: real captures to show on the contact sheet of each validation.

    Args:
        captures: files and folders of real captures, which have no scene to compare with; the first six are shown.
            Paths are relative to the recipe's folder. They do not influence the training.
    """

    captures: tuple[str, ...] = ()
