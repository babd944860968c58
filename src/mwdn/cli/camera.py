"""What most commands share: the camera's options, and where they print."""

from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from mwdn.calibration import Calibration
from mwdn.calibration.frames import Mosaic
from mwdn.errors import MwdnError

console = Console()
errors = Console(stderr=True)


@Parameter(name="*")
@dataclass(frozen=True)
class CameraOptions:
    """The camera's calibration and how its raw frames are stored."""

    psf: Path
    """Picture of a point source: PNG, TIFF or NPY, linear in light."""
    _: KW_ONLY
    dark: Path | None = None
    """Frame taken without light, subtracted from PSF and captures."""
    background: float | None = None
    """Even light under the PSF, as a part of the full scale; estimated unless given."""
    bit_depth: int | None = None
    """Bits of the sensor, where its numbers do not fill the file's type."""
    crop: tuple[int, int] | None = None
    """Height and width of the middle part of each frame to use."""
    bin: int = 1
    """Average blocks of so many pixels along each axis."""
    psf_bin: int | None = None
    """The same for the PSF, where it was taken at another resolution than the captures."""
    upside_down: bool = False
    """The files' first row is the picture's last (DiffuserCam's .npy)."""
    bgr: bool = False
    """The files' channels are blue, green, red (DiffuserCam's .npy)."""

    mosaic: Mosaic | None = None
    """The files are raw frames of a colour filter array of this order: each 2 x 2 cells become a pixel."""
    grey: bool = False
    """Average the colours of PSF and captures."""

    def load(self) -> Calibration:
        """Read the calibration."""
        return Calibration.from_file(
            self.psf,
            dark=self.dark,
            background="estimate" if self.background is None else self.background,
            bit_depth=self.bit_depth,
            crop=self.crop,
            binning=self.bin,
            psf_binning=self.psf_bin,
            upside_down=self.upside_down,
            bgr=self.bgr,
            mosaic=self.mosaic,
            grey=self.grey,
        )


def warn(*warnings: str | None) -> None:
    """Print why not to trust what will come, where there is a reason."""
    for warning in filter(None, warnings):
        errors.print(f"[yellow]Warning:[/] {escape(warning)}", highlight=False, soft_wrap=True)


def complain(start: str, error: MwdnError) -> None:
    """Print a message whole: its brackets are no markup, and its paths are not broken at the terminal's width."""
    errors.print(f"{start} {escape(str(error))}", highlight=False, soft_wrap=True)
