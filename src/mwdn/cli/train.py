"""`mwdn train` and `mwdn simulate`."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from mwdn.calibration import Calibration
from mwdn.cli.camera import CameraOptions
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.progress import Progressing, show_progress, track
from mwdn.cli.recipe_keys import RecipeKeys, recipe_changes
from mwdn.cli.terminal import all_or_nothing, counted, note, notes, say, warn
from mwdn.data.captures import list_captures
from mwdn.data.pair_checks import other_camera
from mwdn.data.pairs import PairFile
from mwdn.errors import ParameterError
from mwdn.io.files import refuse_overwrite
from mwdn.io.listing import unused_files
from mwdn.optics.distortion import displacement_px
from mwdn.optics.shading import shading
from mwdn.runtime import distributed
from mwdn.training import experiment
from mwdn.training.network import takes_channels
from mwdn.training.recipe import Schedule, read_recipe
from mwdn.training.report import Report
from mwdn.training.tables import Sheet
from mwdn.training.tensorboard import TensorBoard
from mwdn.training.trainer import Trainer


@no_empty_folder
def train(  # noqa: PLR0913
    recipe: Path,
    *,
    camera: CameraOptions = CameraOptions(),
    photos: Path | None = None,
    pairs_file: Annotated[Path | None, Parameter(name="--pairs")] = None,  # `pairs` is the table of --pairs.split
    captures: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative=())] = None,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("runs/train"),
    device: str | None = None,
    tensorboard: Annotated[bool, Parameter(negative=())] = False,
    **changes: RecipeKeys,
) -> None:
    """Train a network for one camera, on simulated captures, on recorded pairs, or on captures without scenes.

    Give either --photos or --pairs; or only --captures, with a recipe that has [selfsupervised]. The same command
    resumes an interrupted run.

    Options override keys of the recipe: --steps 500 and --learning-rate 1e-4 those of [schedule], --mismatch.blur-px
    0.5, --network.width 32 and --placement.extent "[0.3, 0.7]" those of other tables.

    On several GPUs or machines: torchrun --nproc-per-node 4 -m mwdn train ...

    Args:
        recipe: name of a recipe of the package, see `mwdn recipes`, or a TOML file.
        camera: calibration of the camera.
        photos: folder of photographs, the more the better, to simulate captures of.
        pairs_file: HDF5 file of pairs, from `mwdn align`, `mwdn import` or `mwdn simulate`; [pairs] of the recipe, or
            --pairs.split random, divides it.
        captures: files or folders of real captures: to learn from, with [selfsupervised]; otherwise to show on
            validation.png in place of those that the recipe names.
        out: folder of the run: best.safetensors for `mwdn reconstruct --method`, validation.png with the images of the
            latest validation.
        device: cpu, cuda, cuda:1 ...; by default a GPU if there is one.
        tensorboard: write progress to the folder tensorboard in --out, for `tensorboard --logdir`.
        **changes: any key of the recipe.
    """
    given = recipe_changes(changes)
    _refuse_unused(given, pairs=pairs_file is not None)
    experiment_recipe = read_recipe(recipe, **given)
    if captures:
        experiment_recipe = replace(experiment_recipe, sheet=Sheet(tuple(map(str, captures))))
    with distributed.process_group(), ExitStack() as stack:
        is_first = distributed.rank() == 0
        if is_first and experiment_recipe.sheet.captures:
            note(*list_captures(experiment_recipe.sheet.captures, exclude=camera.roles).skipped)
        if is_first and photos is not None:
            note(*unused_files(photos))
        with notes.status("Reading photographs, pairs or captures"):
            calibration = camera.load()
            trainer = experiment.prepare(
                experiment_recipe,
                calibration,
                out=out,
                photos=photos,
                pairs=pairs_file,
                device=device,
                exclude=camera.roles,
            )
        one_camera = photos is not None and not experiment_recipe.cameras.sizes
        if is_first and one_camera and not takes_channels(trainer.network, 1):
            _note_colours(calibration, "--grey --network.channels 1")
        if is_first and pairs_file is not None:
            warn(other_camera(PairFile(pairs_file), calibration))
        if is_first and trainer.finished:
            note(f"The run in `{out}` was finished before. To train anew: another `--out`.")
        elif is_first:
            _note_warmup(trainer.schedule)
        board = (
            stack.enter_context(TensorBoard(out / "tensorboard", trainer.step)) if tensorboard and is_first else None
        )
        _train(trainer, stack.enter_context(show_progress(enabled=is_first, titles=True)), board)
    if is_first:
        say(f"Weights in {out / 'best.safetensors'}")


def _refuse_unused(changes: Mapping[str, Any], *, pairs: bool) -> None:
    """Raise a `ParameterError` for changes of tables that a training does not use, of pairs or of photographs."""
    unused = {"mismatch", "placement"} if pairs else {"pairs"}
    for table in unused & changes.keys():
        key = next(iter(changes[table]), "") if isinstance(changes[table], dict) else ""
        raise ParameterError(
            f"`--{table}.{key.replace('_', '-')}` is for {'simulated captures' if pairs else 'recorded pairs'}. Leave "
            f"it out with `{'pairs' if pairs else 'photos'}`."
        )


def _note_colours(calibration: Calibration, options: str) -> None:
    """Say that captures are simulated in colour if nothing but the PSF, which is grey, tells what the camera's are."""
    frames = calibration.frames
    if calibration.psf.shape[1] == 1 and not frames.grey and frames.mosaic is None:
        note(f"The PSF is grey; captures are simulated in colour. If those of the camera are grey: `{options}`.")


def _note_warmup(schedule: Schedule) -> None:
    """Say that a run ends within its warm-up, as a short trial of a recipe does."""
    if schedule.lr_schedule != "plateau" and schedule.steps <= schedule.warmup:
        shorter = f"--schedule.warmup {schedule.steps // 10}"
        note(
            f"The warm-up ({schedule.warmup:,} steps) is not over when the run ends ({schedule.steps:,}): the learning "
            f"rate does not reach {schedule.learning_rate:g}. To shorten it: `{shorter}`."
        )


def _train(trainer: Trainer, progress: Progressing, board: TensorBoard | None) -> None:
    """Train, and show both phases: samples, if the recipe caches them, and steps."""

    def start_training() -> None:
        progress.start("Training", trainer.schedule.steps, trainer.step)

    def show_samples(done: int, total: int) -> None:
        if progress.phase is None:
            progress.start("Preparing samples", total, done)
        progress.update(done, f"{done:,} of {counted(total, 'sample')}")
        if done == total:
            progress.print(_kept(trainer))
            start_training()

    def show_step(report: Report) -> None:
        best = f"loss {-trainer.best:.4f}" if trainer.schedule.best_by == "loss" else f"{trainer.best:.2f} dB"
        if report.step == 1:
            for line in _measured(trainer):
                progress.print(line)
            if trainer.schedule.anchor and report.validation is None:
                progress.print(f"start: validation {best}")
        speed = f"{report.pictures_per_s:.1f} pictures/s"
        progress.update(report.step, f"step {report.step:,}, {speed}, loss {report.loss:.4f}")
        if report.validation is not None:
            progress.print(f"step {report.step}: validation {report.validation.psnr:.2f} dB, best {best}")
        if board is not None:
            board(report)

    if trainer.task.cache is None and not trainer.finished:
        start_training()
    trainer.run(show_step, samples=show_samples)


def _measured(trainer: Trainer) -> Iterator[str]:
    """Sentences about the distortion and the shading of recorded pairs' scenes, if the scenes have any."""
    network, cache = trainer.network, trainer.task.cache
    if cache is None:
        return
    height, width = next(iter(cache.samples.values())).scene.shape[-2:]
    distortion, uneven = (getattr(network, name, None) for name in ("distortion", "shading"))
    if distortion is not None and distortion.any():
        mean, largest = displacement_px(distortion.cpu(), (height, width))
        yield f"Distortion of the scenes, corrected: {mean:.1f} px (root mean square), {largest:.1f} px at most."
    if uneven is not None and uneven.any():
        least, most = shading(uneven.cpu(), (height, width)).aminmax()
        yield f"Shading of the scenes, corrected: {least:.2f} to {most:.2f} times the reconstructions' light."


def _kept(trainer: Trainer) -> str:
    size = trainer.folder.samples_size()
    if size == 0:
        return "The disk has no room for the samples: an interrupted run simulates them again."
    return f"The samples are kept in {trainer.out / 'samples'} until the run ends: {size / 1e6:,.0f} MB"


@no_empty_folder
def simulate(
    photos: Path,
    *,
    camera: CameraOptions = CameraOptions(),
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("pairs.h5"),
    count: int = 100,
    recipe: Path | None = None,
    exact: bool = False,
    **changes: RecipeKeys,
) -> None:
    """Write a file of pairs: photographs as scenes, and simulated captures of them.

    Options override keys of the recipe: --seed 1, --sensor.full-well 2000, --mismatch.blur-px 0.5.

    Args:
        photos: folder of photographs.
        camera: calibration of the camera.
        out: file of pairs, ending in .h5 or .hdf5; an existing one is replaced on success.
        count: number of pairs.
        recipe: placement, mismatch, sensor and seed, as for `mwdn train`; without it the defaults of these tables.
        exact: simulate the calibrated camera itself, without mismatch; noise and even light (--placement.ambient) stay.
        **changes: any key of the recipe.
    """
    refuse_overwrite(out, *camera.files, recipe)
    if exact and "mismatch" in changes:
        raise ParameterError("`exact` leaves out all mismatch: leave out `exact`, or the keys of `mismatch`.")
    simulation = read_recipe(recipe, **recipe_changes(changes))
    progress = partial(track, title="Simulating")
    note(*unused_files(photos))
    calibration = camera.load()
    _note_colours(calibration, "--grey")
    with all_or_nothing(out):
        experiment.simulate(simulation, calibration, photos=photos, out=out, count=count, exact=exact, track=progress)
    say(f"{counted(count, 'pair')} written to {out}")
