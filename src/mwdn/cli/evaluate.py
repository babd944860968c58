"""`mwdn evaluate`: compare methods on pairs of measurements and scenes."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.progress import Progress

from mwdn.cli.camera import CameraOptions, console, errors, warn
from mwdn.evaluation import Variant
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import check_folder, refuse_overwrite


def evaluate(
    *methods: str,
    data: Path,
    camera: CameraOptions,
    protocol: str = "full",
    variant: Variant | None = None,
    first: int | None = None,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/evaluate"),
    device: str | None = None,
) -> None:
    """Compare methods on pairs of measurements and scenes: quality, time, memory.

    Args:
        methods: names of solvers or bundled networks, see `mwdn methods`, or paths of checkpoints.
        data: HDF5 file of pairs.
        camera: calibration of the camera that took them.
        protocol: full, centre-128 (the paper's), or rows and columns such as 60:270,60:440 (DiffuserCam's).
        variant: raw, clipped to [0, 1], or best-gain (one gain and offset per picture). The default is raw for
            centre-128 and clipped otherwise.
        first: use only this many pairs.
        out: folder for report.json and comparison.png.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
    """
    from mwdn import evaluation
    from mwdn.data.pairs import PairFile
    from mwdn.data.recorded import check_pairs, other_camera

    part, calibration, file = evaluation.Protocol.parse(protocol), camera.load(), PairFile(data)
    check_pairs(file, calibration.psf)
    pairs = file if first is None else evaluation.First(file, first)
    reconstructors = {method: Reconstructor(method, calibration, device=device) for method in methods}
    warnings = [reconstruct.warning for reconstruct in reconstructors.values()]
    warn(*warnings, other_camera(file, calibration.psf_hash))
    refuse_overwrite(out / evaluation.SHEET, camera.psf, camera.dark)
    check_folder(out)
    with Progress(console=errors, transient=True) as bars:
        bar = bars.add_task("Evaluating", total=len(reconstructors) * len(pairs))
        report = evaluation.evaluate(
            reconstructors,
            pairs,
            part,
            variant=variant,
            progress=lambda name, _: bars.update(bar, advance=1, description=name),
        )
    table = report.table()
    width = console.measure(table, options=console.options.update(width=1000)).maximum
    console.print(report.table(narrow=True) if width > console.width else table)
    report.write(out)
    console.print(f"Look at {out}", highlight=False, markup=False, soft_wrap=True)
