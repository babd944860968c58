"""Options of the camera, and output to the terminal: shared by most commands."""

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from mwdn.calibration import Calibration, FrameFormat
from mwdn.errors import MwdnError

console = Console()
errors = Console(stderr=True)


@Parameter(name="*")
@dataclass(frozen=True)
class CameraOptions:
    """The camera's PSF and the format of its raw frames.

    Args:
        psf: picture of a point source: PNG, TIFF or NPY, linear in light.
        frames: format of the PSF, the dark frame and the captures.
        psf_bin: the value of --bin for the PSF, if it was taken at another resolution than the captures.
        dark: frame taken without light, subtracted from the PSF and the captures.
        background: uniform light under the PSF, as a fraction of the full scale; estimated if not given.
    """

    psf: Path
    frames: Annotated[FrameFormat, Parameter(name="*")] = FrameFormat()
    _: KW_ONLY
    psf_bin: int | None = None
    dark: Path | None = None
    background: float | None = None

    def load(self) -> Calibration:
        """Read the calibration."""
        return Calibration.from_file(
            self.psf,
            self.frames,
            dark=self.dark,
            background="estimate" if self.background is None else self.background,
            psf_bin=self.psf_bin,
        )


def warn(*warnings: str | None) -> None:
    """Print each warning that is not ``None``."""
    for warning in filter(None, warnings):
        errors.print(f"[yellow]Warning:[/] {escape(warning)}", highlight=False, soft_wrap=True)


def complain(start: str, error: MwdnError) -> None:
    """Print an error on one line: brackets are not markup, and paths are not wrapped at the terminal's width."""
    errors.print(f"{start} {escape(str(error))}", highlight=False, soft_wrap=True)
