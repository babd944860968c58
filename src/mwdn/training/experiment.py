"""From a recipe, a calibration and pictures to a training run, or to a file of simulated pairs."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from mwdn.arguments import check_at_least, checked
from mwdn.calibration import Calibration
from mwdn.calibration.places import field_camera
from mwdn.calibration.psf_identity import psf_identity
from mwdn.calibration.refinement import Refinement
from mwdn.data.cameras import CameraPairs
from mwdn.data.captures import find_captures, read_captures
from mwdn.data.mismatch import EXACT
from mwdn.data.noisy import NoisyScenes
from mwdn.data.pair_checks import REFINED
from mwdn.data.pair_writer import Attribute, check_path
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import HELD_OUT, record, recorded_pairs
from mwdn.data.simulated import Samples, SimulatedPairs
from mwdn.data.unpaired import UnpairedCaptures
from mwdn.errors import CheckpointError, ParameterError
from mwdn.io.listing import refuse_within
from mwdn.networks.empty import build_empty
from mwdn.optics.sensor import Sensor
from mwdn.runtime import distributed
from mwdn.training.network import check_colours, stored_psf
from mwdn.training.recipe import Recipe, read_recipe
from mwdn.training.report import Report
from mwdn.training.selfsupervised import SelfSupervisedTask
from mwdn.training.tasks import SupervisedTask, Task, pair_tasks, supervised_task, with_stored_psf
from mwdn.training.trainer import Trainer
from mwdn.training.validation import SHEET_ROWS, Validator
from mwdn.types import Measurement, Psf

FILE_START = 2 * 10**12
"""Number of the first sample in a file of simulated pairs, beyond those of any training with the same seed."""


class TrainingData(NamedTuple):
    """Tasks of training and validation, and their numbers of samples.

    Args:
        task: to train on.
        validation: to validate on.
        epoch: number of training samples in an epoch.
        validation_count: number of different validation samples; ``None`` if unlimited.
    """

    task: Task
    validation: Task
    epoch: int
    validation_count: int | None = None


@checked
def train(
    recipe: Recipe | str | Path,
    calibration: Calibration,
    *,
    out: str | Path,
    photos: str | Path | None = None,
    pairs: str | Path | None = None,
    device: str | None = None,
    callback: Callable[[Report], None] = lambda report: None,
) -> Path:
    """Train a network for a camera; called again on the same folder, it continues a stopped run.

    Args:
        recipe: the experiment, its TOML file, or the name of a recipe of the package.
        calibration: of the camera.
        out: folder of the run.
        photos: folder of photographs to simulate captures of.
        pairs: file of recorded pairs, instead of photographs.
        device: a GPU by default if there is one.
        callback: called after each step.

    Returns:
        The checkpoint of the best validation, for `mwdn.Reconstructor`.

    Raises:
        MwdnError: as for `prepare` and `mwdn.training.trainer.Trainer.run`.
    """
    recipe = recipe if isinstance(recipe, Recipe) else read_recipe(recipe)
    photos, pairs = (None if path is None else Path(path) for path in (photos, pairs))
    trainer = prepare(recipe, calibration, out=Path(out), photos=photos, pairs=pairs, device=device)
    trainer.run(callback)
    return trainer.folder.weights("best")


def prepare(
    recipe: Recipe,
    calibration: Calibration,
    *,
    out: Path,
    photos: Path | None = None,
    pairs: Path | None = None,
    device: str | None = None,
    exclude: Mapping[str, Path] | None = None,
) -> Trainer:
    """Read the training data and set up the run.

    Args:
        recipe: the experiment. With [selfsupervised] it learns from all captures of its [sheet], and takes neither
            ``photos`` nor ``pairs``.
        calibration: of the camera.
        out: folder of the run.
        photos: folder of photographs to simulate captures of; every 20th is held out for validation.
        pairs: file of recorded pairs, instead of photographs.
        device: a GPU by default if there is one.
        exclude: files among those of [sheet] that are no captures: ``{"PSF": psf, "dark frame": dark}``.

    Raises:
        ParameterError: not exactly one of photographs, pairs and captures, or not enough of them.
        MwdnError: torch cannot use the device, a file cannot be read or does not fit the camera, or the folder holds
            another run.
    """
    place = distributed.local_device(device)
    recipe = _with_sensor(recipe, calibration)
    psf = calibration.psf.to(place)
    _check_one_source(recipe, photos, pairs)
    for path in recipe.sheet.captures:
        refuse_within(path, out, of="captures")
    captures = _read_captures(recipe, calibration, exclude, place)
    if recipe.selfsupervised.consistency and captures is not None:
        data = captures_alone(recipe, captures, psf)
        captures = None  # shown as samples of the validation
    elif pairs is not None:
        data = recorded_pairs_of(recipe, pairs, psf, refinement=calibration.refinement)
    elif photos is not None:
        refuse_within(photos, out)
        data = simulated_captures(recipe, photos, psf, is_grey=calibration.frames.grey)
    recipe = _in_steps(recipe, data)
    stored = stored_psf(recipe, calibration, place)
    task, validation = (with_stored_psf(part, stored) for part in (data.task, data.validation))
    validator = Validator(recipe, validation, psf if stored is None else stored, captures)
    trainer = Trainer(recipe, task, out=out, calibration=calibration, validator=validator, device=place)
    _check_same_samples(trainer, out, photos=photos, pairs=pairs)
    return trainer


def _check_same_samples(trainer: Trainer, out: Path, *, photos: Path | None, pairs: Path | None) -> None:
    """Refuse to continue a run on other samples, except an unfinished one on other photographs, such as more."""
    if not trainer.compare_samples() and (trainer.finished or pairs is not None):
        kind = "pairs" if pairs else "photographs"
        raise CheckpointError(
            f"`{out}` holds a run of the same recipe on other {kind} than those of `{pairs or photos}`. "
            "Choose another folder, `out`, or remove it."
        )


def simulated_captures(recipe: Recipe, photos: Path, psf: Psf, *, is_grey: bool) -> TrainingData:
    """Captures simulated from photographs, through one camera or random ones; or noisy scenes for a denoiser.

    Raises:
        ParameterError: the one camera is grey, but the network takes colours.
    """
    if is_grey and not (recipe.cameras.sizes or recipe.denoising.levels[1]):
        _check_colours(recipe, 1, "this camera (`grey`)")
    photographs, held_out = Photographs(photos).to(psf.device).split(HELD_OUT)
    grey = getattr(build_empty(**recipe.network), "channels", 0) == 1
    pairs, held_out_pairs = (_simulated_pairs(recipe, part, psf, grey=grey) for part in (photographs, held_out))
    training: Samples = pairs
    validation: Samples = held_out_pairs
    if recipe.denoising.levels[1]:
        training, validation = NoisyScenes(pairs, recipe.denoising), NoisyScenes(held_out_pairs, recipe.denoising)
    elif recipe.cameras.sizes:
        training = CameraPairs(pairs, recipe.cameras, recipe.schedule.batch)
    return TrainingData(supervised_task(training, recipe.schedule), SupervisedTask(validation), len(photographs))


def recorded_pairs_of(recipe: Recipe, pairs: Path, psf: Psf, *, refinement: Refinement) -> TrainingData:
    """Recorded pairs of one camera."""
    if recipe.cameras.sizes:
        raise ParameterError("Recorded pairs, `--pairs`, are of one camera: leave [cameras] out of the recipe.")
    if recipe.denoising.levels[1]:
        raise ParameterError("[denoising] makes its own pairs from photographs: give `photos`, not `pairs`.")
    seed = recipe.schedule.seed
    training, validation = recorded_pairs(pairs, psf, recipe.pairs, seed=seed, device=psf.device, refinement=refinement)
    _check_colours(recipe, training.file.measurement_shape[2], f"`{pairs}`")
    task, held_out = pair_tasks(training, validation, recipe.schedule, best_gain=recipe.pairs.best_gain)
    return TrainingData(task, held_out, len(training), len(validation))


def _check_colours(recipe: Recipe, colours: int, of: str) -> None:
    check_colours(recipe.network, colours, of=of, way_out=f"Give `--network.channels {colours}`.")


def captures_alone(recipe: Recipe, captures: Measurement, psf: Psf) -> TrainingData:
    """Captures without scenes, for training and validation alike."""
    task = SelfSupervisedTask(UnpairedCaptures(captures, psf, recipe.selfsupervised, recipe.schedule.seed))
    return TrainingData(task, task, len(captures), len(captures))


def _check_one_source(recipe: Recipe, photos: Path | None, pairs: Path | None) -> None:
    if recipe.selfsupervised.consistency:
        if photos is not None or pairs is not None or not recipe.sheet.captures:
            raise ParameterError(
                "A recipe with [selfsupervised] learns from captures alone: give `captures` (in the recipe: [sheet]), "
                "and neither `photos` nor `pairs`."
            )
    elif photos is None and pairs is None:
        raise ParameterError(
            "Give photographs to learn from, `photos`, or recorded pairs, `pairs`. "
            "To learn from captures alone: `mwdn train selfsupervised --captures FOLDER`."
        )
    elif photos is not None and pairs is not None:
        raise ParameterError(f"Photographs (`{photos}`) and pairs (`{pairs}`) exclude each other. Leave one out.")


def _read_captures(
    recipe: Recipe, calibration: Calibration, exclude: Mapping[str, Path] | None, device: torch.device
) -> Measurement | None:
    """Captures of [sheet]: all to learn from them, otherwise as many as a contact sheet shows."""
    if not recipe.sheet.captures:
        return None
    files = find_captures(recipe.sheet.captures, exclude=exclude)
    learns = recipe.selfsupervised.consistency > 0
    return read_captures(files if learns else files[:SHEET_ROWS], calibration, lit=learns).to(device)


def _simulated_pairs(recipe: Recipe, photographs: Photographs, psf: Psf, *, grey: bool) -> SimulatedPairs:
    return SimulatedPairs(
        photographs,
        psf,
        placement=recipe.placement,
        mismatch=recipe.mismatch,
        sensor=recipe.sensor,
        seed=recipe.schedule.seed,
        grey=grey,
    )


def simulated_sensor(sensor: Sensor, calibration: Calibration) -> Sensor:
    """The sensor to simulate: that of a recipe, or the camera's measured one if the recipe has none of its own."""
    measured = calibration.binned_sensor
    return sensor if measured is None or sensor != Sensor() else measured


def _with_sensor(recipe: Recipe, calibration: Calibration) -> Recipe:
    """The recipe with its `simulated_sensor`, unless its cameras are random."""
    return recipe if recipe.cameras.sizes else replace(recipe, sensor=simulated_sensor(recipe.sensor, calibration))


def _in_steps(recipe: Recipe, data: TrainingData) -> Recipe:
    """Epochs as steps, with a validation after each; and no validation sample twice."""
    schedule = recipe.schedule
    if data.validation_count is not None:
        schedule = replace(schedule, validation=min(schedule.validation, data.validation_count))
    if schedule.epochs:
        steps = math.ceil(data.epoch / schedule.batch)
        schedule = replace(schedule, steps=schedule.epochs * steps, validate_every=steps)
    return replace(recipe, schedule=schedule)


@checked
def simulate(
    recipe: Recipe | str | Path,
    calibration: Calibration,
    *,
    photos: str | Path,
    out: str | Path,
    count: int,
    exact: bool = False,
    track: Callable[[list[range]], Iterable[range]] = iter,
) -> None:
    """Write simulated pairs to a file, which appears when it is complete.

    Args:
        recipe: its placement, mismatch, sensor and seed are used; or its TOML file, or the name of a recipe of the
            package.
        calibration: of the camera.
        photos: folder of photographs.
        out: the file of pairs, ending in .h5 or .hdf5; an existing one is replaced on success.
        count: number of pairs.
        exact: simulate the calibrated camera itself, without the recipe's mismatch and the PSFs of its field.
        track: wraps the batches to show progress.

    Raises:
        MwdnError: ``count`` is not positive, a photograph cannot be read, or the file cannot be written.
    """
    recipe = recipe if isinstance(recipe, Recipe) else read_recipe(recipe)
    out = Path(out)
    check_path(out)
    check_at_least(1, count=count)
    grey, photographs = calibration.frames.grey, Photographs(Path(photos))
    pairs = _simulated_pairs(_with_sensor(recipe, calibration), photographs, calibration.psf, grey=grey)
    if exact:
        pairs = replace(pairs, mismatch=EXACT)
    elif calibration.places.field_psfs:  # the measured field, instead of random changes of one PSF
        pairs = replace(pairs, camera=field_camera(calibration))
    attributes: dict[str, Attribute] = {**psf_identity(calibration), "seed": pairs.seed, REFINED: "simulate"}
    numbers = range(FILE_START, FILE_START + count)
    batch, channels = recipe.schedule.batch, 1 if grey else 3
    parts = [(pairs, numbers)]
    record(out, parts, calibration.psf, batch=batch, channels=channels, attributes=attributes, track=track)
