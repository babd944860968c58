"""Progress of a run: what a callback and a line of the log hold."""

from dataclasses import dataclass

from mwdn.training.validation import Validation


@dataclass(frozen=True)
class Report:
    """Progress after a step, for a callback."""

    step: int
    loss: float
    parts: dict[str, float]
    learning_rate: float
    pictures_per_s: float
    validation: Validation | None = None

    def line(self) -> dict[str, float | int | None]:
        """The step's line in the log."""
        line = {"step": self.step, "loss": self.loss, **self.parts, "learning_rate": self.learning_rate}
        psnr, loss = (None, None) if self.validation is None else (self.validation.psnr, self.validation.loss)
        return {**line, "psnr": psnr, "validation_loss": loss}
