"""Progress of a run in TensorBoard, an optional dependency."""

from pathlib import Path
from typing import Any

from mwdn.io.files import as_parameter_error
from mwdn.io.images import srgb_encode
from mwdn.runtime.requirement import require
from mwdn.training.report import Report


class TensorBoard:
    """Writes event files: a callback for `Trainer.run`, to be used in a ``with`` statement.

    Args:
        folder: for the event files, to be shown by ``tensorboard --logdir``; it is made if it is missing.
        step: of the saved state. Events of later steps are hidden: a resumed run repeats them.

    Raises:
        MissingPackageError: TensorBoard is not installed.
        ParameterError: the folder cannot be written to.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        require("tensorboard", "tensorboard", purpose="`--tensorboard`")
        from torch.utils.tensorboard import SummaryWriter

        with as_parameter_error(folder):
            self._writer: Any = SummaryWriter(str(folder), purge_step=step + 1)

    def __call__(self, report: Report) -> None:
        """Write the numbers of a step, and those and the contact sheet of a validation."""
        scalars = {f"loss/{name}": value for name, value in {"total": report.loss, **report.parts}.items()}
        scalars |= {"learning_rate": report.learning_rate, "pictures_per_s": report.pictures_per_s}
        if report.validation is not None:
            scalars |= {"validation/psnr": report.validation.psnr, "validation/loss": report.validation.loss}
            if report.validation.sheet is not None:
                self._writer.add_image("validation", srgb_encode(report.validation.sheet[0]), report.step)
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, report.step)

    def __enter__(self) -> "TensorBoard":
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()
