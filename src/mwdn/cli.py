"""The command line: one short function a command."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import cyclopts
from cyclopts import App, Parameter
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from torch import Tensor

from mwdn import __version__
from mwdn.calibration import Calibration
from mwdn.data.images import write_picture
from mwdn.data.sheets import contact_sheet
from mwdn.errors import MwdnError
from mwdn.reconstruct import (
    SUMMARY,
    Format,
    Reconstructor,
    find_captures,
    find_method,
    plan_outputs,
    reconstruct_file,
)

app = App(
    name="mwdn",
    version=__version__,
    help="From the caustic pattern of a lensless camera to a picture. Add --debug to see where an error comes from.",
)
console = Console()
errors = Console(stderr=True)


@Parameter(name="*")
@dataclass(frozen=True)
class CameraOptions:
    """The camera's calibration and how its raw frames are stored."""

    psf: Path
    """Picture of a point source: PNG, TIFF or NPY, linear in light."""
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
    upside_down: bool = False
    """The files' first row is the picture's last (DiffuserCam's .npy)."""
    bgr: bool = False
    """The files' channels are blue, green, red (DiffuserCam's .npy)."""

    def load(self) -> Calibration:
        """Read the calibration."""
        return Calibration.from_file(
            self.psf,
            dark=self.dark,
            background="estimate" if self.background is None else self.background,
            bit_depth=self.bit_depth,
            crop=self.crop,
            binning=self.bin,
            upside_down=self.upside_down,
            bgr=self.bgr,
        )


@app.command
def reconstruct(
    *captures: Path,
    camera: CameraOptions,
    method: str = "admm",
    regularisation: float | None = None,
    out: Path = Path("results/reconstruct"),
    format: Format = "png",
    device: str | None = None,
) -> int:
    """Reconstruct captures: files, or folders of them.

    Args:
        captures: raw frames of the camera.
        camera: its calibration.
        method: admm, wiener, fista, or the path of a checkpoint.
        regularisation: tau of admm or lambda of wiener; less keeps more detail and more noise.
        out: folder for the pictures; summary.png shows the first twelve beside their measurements.
        format: png and png16 are sRGB for people, tiff and npy hold the linear float32 values.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
    """
    calibration = camera.load()
    files = find_captures(captures)
    outputs = plan_outputs(files, out, format, protected=(camera.psf, camera.dark))
    reconstructor = Reconstructor(find_method(method, regularisation), calibration, device=device)
    levels = ", ".join(f"{level:.4f}" for level in calibration.background)
    console.print(f"PSF {calibration.psf_hash}, background {levels} of the full scale subtracted")
    failed = 0
    rows: list[list[Tensor]] = []
    for file, output in track(list(zip(files, outputs, strict=True)), "Reconstructing", disable=len(files) == 1):
        try:
            pair = reconstruct_file(reconstructor, file, output, format)
        except MwdnError as error:
            failed += 1
            _complain(f"[red]{escape(str(file))}:[/]", error)
            continue
        rows = [*rows, list(pair)] if len(rows) < 12 else rows
    if rows:
        write_picture(out / SUMMARY, contact_sheet(rows, ["measurement", f"reconstruction ({Path(method).name})"]))
    done = f"{len(files) - failed} of {len(files)} captures reconstructed into {out}"
    console.print(done, highlight=False, markup=False, soft_wrap=True)
    return 1 if failed else 0


@app.command
def demo(*, out: Path = Path("results/demo"), seed: int = 0) -> None:
    """Make a small synthetic camera, capture pictures with it and reconstruct them with every untrained method.

    Args:
        out: folder for the comparison picture and the page.
        seed: of the camera and of its noise; another seed is another camera.
    """
    from mwdn.demo import run

    run(out, seed, console)


@app.command
def doctor() -> None:
    """Print versions, devices, supported precisions and threads."""
    from mwdn.doctor import report

    report(console)


def _complain(start: str, error: MwdnError) -> None:
    """Print a message whole: its brackets are no markup, and its paths are not broken at the terminal's width."""
    errors.print(f"{start} {escape(str(error))}", highlight=False, soft_wrap=True)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit: 0 if all went well, 1 if some captures failed, 2 on a wrong call."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    try:
        result = app([a for a in arguments if a != "--debug"], exit_on_error=False, print_error=True)
    except cyclopts.CycloptsError:
        sys.exit(2)
    except MwdnError as error:
        if debug:
            errors.print_exception()
        _complain("[bold red]Error:[/]", error)
        sys.exit(2)
    sys.exit(result if isinstance(result, int) else 0)
