"""The command line: one short function a command."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

import cyclopts
from cyclopts import App, Parameter
from rich.markup import escape
from rich.progress import Progress, track

from mwdn.calibration import FrameFormat
from mwdn.cli.benchmark import benchmark
from mwdn.cli.camera import CameraOptions, complain, console, errors, warn
from mwdn.cli.design import design
from mwdn.cli.export import export
from mwdn.cli.inspect import inspect
from mwdn.cli.reconstruct import reconstruct
from mwdn.cli.train import simulate, train
from mwdn.data.importers import Layout, import_pairs
from mwdn.errors import MwdnError
from mwdn.evaluation import Variant
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import check_folder, refuse_overwrite
from mwdn.runtime.memory import keep_memory
from mwdn.version import __version__

app = App(
    name="mwdn",
    version=__version__,
    help="From the caustic pattern of a lensless camera to a picture. Add --debug to see where an error comes from.",
)
for command in (reconstruct, design, inspect, simulate, train, export, benchmark):
    app.command(command)


@app.command(name="import")
def import_(
    kind: str,
    path: Path,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("pairs.h5"),
    skip_damaged: bool = False,
    layout: Annotated[Layout, Parameter(name="*")] = Layout(),
    frames: Annotated[FrameFormat, Parameter(name="*")] = FrameFormat(),
) -> None:
    """Turn a public data set, or two folders of pictures, into one file of pairs.

    Args:
        kind: mwdn (the authors' HDF5), diffusercam, phlatcam, folders (captures/ and scenes/), or parquet.
        path: of the data set; for parquet a shard, a folder of shards, or owner/name on the Hugging Face hub.
        out: the file of pairs, ending in .h5 or .hdf5; one that exists is replaced when all has gone well.
        skip_damaged: leave out what is damaged or has no partner, and name it.
        layout: where this copy of the data set differs from the usual.
        frames: format of the captures, where it differs from the usual.
    """
    progress = partial(track, description="Importing")
    done = import_pairs(kind, path, out, layout=layout, frames=frames, skip_damaged=skip_damaged, track=progress)
    for reason in done.skipped.values():
        errors.print(f"[yellow]skipped:[/] {escape(reason)}", highlight=False, soft_wrap=True)
    names = f": {', '.join(done.skipped)}" if done.skipped else ""
    summary = f"{done.count:,} pairs written to {out}, {len(done.skipped):,} skipped{names}"
    console.print(summary, markup=False, highlight=False, soft_wrap=True)


@app.command
def evaluate(
    *methods: str,
    data: Path,
    camera: CameraOptions,
    protocol: str = "full",
    variant: Variant | None = None,
    first: int | None = None,
    out: Path = Path("results/evaluate"),
    device: str | None = None,
) -> None:
    """Compare methods on pairs of measurements and scenes: quality, time, memory.

    Args:
        methods: admm, pyramid, wiener, fista, or paths of checkpoints.
        data: HDF5 file of pairs.
        camera: calibration of the camera that took them.
        protocol: full, centre-128 (the paper's), or rows and columns such as 60:270,60:440 (DiffuserCam's).
        variant: raw, clipped to [0, 1], or best-gain (one gain and offset a picture); raw for centre-128 and
            clipped for the others unless given.
        first: use the first so many pairs alone.
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
    warn(*(each.warning for each in reconstructors.values()), other_camera(file, calibration.psf_hash))
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
    needed = console.measure(table, options=console.options.update(width=1000)).maximum
    console.print(report.table(narrow=True) if needed > console.width else table)
    report.write(out)
    console.print(f"Look at {out}", highlight=False, markup=False, soft_wrap=True)


@app.command
def demo(*, out: Path = Path("results/demo"), seed: int = 0) -> None:
    """Make a small synthetic camera, capture pictures with it and reconstruct them with every untrained method.

    Args:
        out: folder for the comparison picture and the page.
        seed: of the camera and of its noise; another seed is another camera.
    """
    from mwdn.cli.demo import run

    run(out, seed, console)


@app.command
def doctor() -> None:
    """Print versions, devices, supported precisions and threads."""
    from mwdn.runtime.environment import print_environment

    print_environment(console)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit: 0 if all went well, 1 if some captures failed, 2 on a wrong call."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    keep_memory()
    try:
        result = app([a for a in arguments if a != "--debug"], exit_on_error=False, print_error=True)
    except cyclopts.CycloptsError:
        sys.exit(2)
    except MwdnError as error:
        if debug:
            errors.print_exception()
        complain("[bold red]Error:[/]", error)
        sys.exit(2)
    sys.exit(result if isinstance(result, int) else 0)
