"""`mwdn train` and `mwdn simulate`: what is learned, and what can be learned from."""

from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.progress import Progress, ProgressColumn, track

from mwdn.cli.camera import CameraOptions, console, errors
from mwdn.io.files import refuse_overwrite
from mwdn.io.toml import parse_value
from mwdn.runtime import distributed
from mwdn.training import experiment
from mwdn.training.recipe import Sheet, read_recipe
from mwdn.training.tensorboard import Board
from mwdn.training.trainer import Report


def _as_recipe(given: Any) -> Any:  # noqa: ANN401
    """What a command line says by ``--key value`` and ``--table.key value``, as a recipe has it."""
    if isinstance(given, dict):
        return {key.replace("-", "_"): _as_recipe(each) for key, each in given.items()}
    return parse_value(given[-1].value)


RecipeKeys = Annotated[Any, Parameter(converter=lambda _, tokens: tokens, show=False)]


def train(  # noqa: PLR0913
    recipe: Path,
    *,
    camera: CameraOptions,
    photos: Path | None = None,
    pairs: Path | None = None,
    captures: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative=())] = None,
    out: Path = Path("runs/train"),
    device: str | None = None,
    tensorboard: Annotated[bool, Parameter(negative=())] = False,
    **changes: RecipeKeys,
) -> None:
    """Train a network for one camera: on captures simulated through its PSF, on recorded pairs, or on captures alone.

    Give either --photos or --pairs, or --captures alone with a recipe that has [selfsupervised].
    Run again, it goes on where it stopped.

    Any key of the recipe can be given another value: --steps 500 or --learning-rate 1e-4 of [schedule], and of the
    other tables --mismatch.blur-px 0.5, --network.width 32, --placement.extent "[0.3, 0.7]".

    Several GPUs or machines: torchrun --nproc-per-node 4 -m mwdn train ...

    Args:
        recipe: TOML file, see recipes/.
        camera: calibration of the camera.
        photos: folder of photographs, the more the better: captures of them are simulated.
        pairs: HDF5 file of recorded pairs, from `mwdn import`; the recipe's [pairs] says which are for what.
        captures: real captures, files or folders: to be shown on the contact sheet instead of the recipe's, or, with
            [selfsupervised], to be learned from.
        out: folder of the run: best.safetensors is what `mwdn reconstruct --method` takes, validation.png shows the
            pictures of the latest validation.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        tensorboard: write progress to the folder tensorboard in --out, for `tensorboard --logdir`.
        **changes: any key of the recipe.
    """
    chosen = read_recipe(recipe, **_as_recipe(changes))
    if captures:
        chosen = replace(chosen, sheet=Sheet(tuple(map(str, captures))))
    columns: list[str | ProgressColumn] = [*Progress.get_default_columns(), "{task.fields[now]}"]
    with distributed.process_group(), ExitStack() as stack:
        apart = camera.psf, camera.dark
        trainer = experiment.prepare(chosen, camera.load(), photos, out, device, pairs=pairs, apart=apart)
        first = distributed.rank() == 0
        write = stack.enter_context(Board(out / "tensorboard", trainer.step)) if tensorboard and first else None
        bars = stack.enter_context(Progress(*columns, console=errors, disable=not first))
        bar = bars.add_task("Training", total=trainer.schedule.steps, completed=trainer.step, now="")

        def show(report: Report) -> None:
            now = f"{report.pictures_per_s:.1f} pictures/s, loss {report.loss:.4f}"
            bars.update(bar, completed=report.step, now=now)
            if report.validation is not None:
                psnr = report.validation.psnr
                bars.print(f"step {report.step}: validation {psnr:.2f} dB, best {trainer.best:.2f} dB")
            if write is not None:
                write(report)

        trainer.run(show)
    if first:
        console.print(f"Weights in {out / 'best.safetensors'}", highlight=False, markup=False, soft_wrap=True)


def simulate(
    photos: Path,
    *,
    camera: CameraOptions,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("pairs.h5"),
    count: int = 100,
    recipe: Path | None = None,
    exact: bool = False,
    **changes: RecipeKeys,
) -> None:
    """Write a file of pairs: photographs as scenes, and what the camera would capture of them.

    Any key of the recipe can be given another value: --seed 1, --sensor.full-well 2000, --mismatch.blur-px 0.5.

    Args:
        photos: folder of photographs.
        camera: calibration of the camera.
        out: the file of pairs, ending in .h5 or .hdf5; one that exists is replaced when all has gone well.
        count: of pairs.
        recipe: TOML file whose placement, mismatch, sensor and seed are used, see recipes/; defaults unless given.
        exact: simulate a camera that is exactly what its calibration says.
        **changes: any key of the recipe.
    """
    refuse_overwrite(out, camera.psf, camera.dark, recipe)
    chosen = read_recipe(recipe, **_as_recipe(changes))
    progress = partial(track, description="Simulating", console=errors, transient=True)
    experiment.simulate(chosen, camera.load(), photos, out, count, exact=exact, track=progress)
    console.print(f"{count:,} pairs written to {out}", markup=False, highlight=False, soft_wrap=True)
