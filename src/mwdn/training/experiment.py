"""What a user does with a recipe, a calibration and pictures: train, or make a file of pairs."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from mwdn.calibration import Calibration
from mwdn.data.cameras import CameraPairs
from mwdn.data.captures import find_captures, read_captures
from mwdn.data.mismatch import EXACT
from mwdn.data.noisy import NoisyScenes
from mwdn.data.pair_writer import Attribute, check_path
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import HELD_OUT, record, recorded_pairs
from mwdn.data.simulated import Samples, SimulatedPairs
from mwdn.data.unpaired import UnpairedCaptures
from mwdn.errors import ParameterError
from mwdn.runtime import distributed
from mwdn.training.recipe import Recipe
from mwdn.training.trainer import Trainer
from mwdn.training.validation import SHOWN
from mwdn.types import Psf

FILE_START = 2 * 10**12
"""Number of the first sample of a file: a network trained with the same seed has seen none of them."""


def prepare(
    recipe: Recipe,
    calibration: Calibration,
    photos: Path | None,
    out: Path,
    device: str | None = None,
    *,
    pairs: Path | None = None,
    apart: Iterable[Path | None] = (),
) -> Trainer:
    """Read what there is to learn from and set the run up.

    Args:
        recipe: the experiment.
        calibration: of the camera.
        photos: folder of photographs, through which captures are simulated; every 20th is held out for validation.
        out: folder of the run.
        device: a GPU if there is one unless given.
        pairs: file of recorded pairs, in place of photographs. A recipe with [selfsupervised] takes neither: it
            learns from all the captures of its [sheet].
        apart: files that are no captures, though a folder of the recipe's [sheet] holds them: the PSF, the dark frame.

    Raises:
        ParameterError: not exactly one of photographs, pairs and captures, as the recipe needs, or not enough of them.
        MwdnError: torch cannot use the device, a file cannot be read or does not fit the camera, or the folder holds
            another run.
    """
    _check_one(recipe, photos, pairs)
    place = distributed.local_device(device)
    shown, alone = recipe.sheet.captures, recipe.selfsupervised.consistency > 0
    files = find_captures(shown, exclude=apart) if shown else []
    real = read_captures(files if alone else files[:SHOWN], calibration) if files else None
    training: Samples
    validation: Samples
    if alone and real is not None:
        psf, seed = calibration.psf.to(place), recipe.schedule.seed
        training = validation = UnpairedCaptures(real.to(place), psf, recipe.selfsupervised, seed)
        count, real = len(training), None
        recipe = _within(recipe, count)
    elif pairs is not None:
        if recipe.cameras.sizes:
            raise ParameterError("Recorded pairs, `--pairs`, are of one camera: leave [cameras] out of the recipe.")
        if recipe.denoising.levels[1]:
            raise ParameterError("[denoising] makes its own pairs from photographs: give `--photos`, not `--pairs`.")
        seed = recipe.schedule.seed
        training, validation = recorded_pairs(pairs, calibration.psf, recipe.pairs, seed=seed, device=place)
        recipe = _within(recipe, len(validation))
        count = len(training)
    elif photos is not None:
        learned, held_out = Photographs(photos).to(place).split(HELD_OUT)
        source = _source(recipe, learned, calibration.psf.to(place))
        validation = replace(source, photographs=held_out)
        across = recipe.cameras.sizes
        training = CameraPairs(source, recipe.cameras, recipe.schedule.batch) if across else source
        if recipe.denoising.levels[1]:
            training, validation = (NoisyScenes(each, recipe.denoising) for each in (source, validation))
        count = len(learned)
    trainer = Trainer(
        _in_steps(recipe, count), calibration, training, out, validation=validation, captures=real, device=place
    )
    trainer.validator.captured(trainer.average)  # a capture that does not fit the network is found now
    return trainer


def simulate(
    recipe: Recipe,
    calibration: Calibration,
    photos: Path,
    out: Path,
    count: int,
    *,
    exact: bool = False,
    track: Callable[[list[range]], Iterable[range]] = iter,
) -> None:
    """Write simulated pairs to a file, which is there only once it is whole.

    Args:
        recipe: its placement, mismatch, sensor and seed are used.
        calibration: of the camera.
        photos: folder of photographs.
        out: the file of pairs, ending in .h5 or .hdf5; one that exists is replaced when all has gone well.
        count: of pairs.
        exact: the camera is what its calibration says, whatever the recipe's mismatch.
        track: shows the progress of an iteration.

    Raises:
        MwdnError: ``count`` is not positive, a photograph cannot be read, or the file cannot be written.
    """
    check_path(out)
    if count < 1:
        raise ParameterError(f"`count` ({count}) must be at least 1.")
    pairs = _source(recipe, Photographs(photos), calibration.psf)
    pairs = replace(pairs, mismatch=EXACT) if exact else pairs
    attributes: dict[str, Attribute] = {"psf_hash": calibration.psf_hash, "seed": pairs.seed}
    part = pairs, range(FILE_START, FILE_START + count)
    record(out, [part], calibration.psf, batch=recipe.schedule.batch, attributes=attributes, track=track)


def _check_one(recipe: Recipe, photos: Path | None, pairs: Path | None) -> None:
    if recipe.selfsupervised.consistency:
        if photos is not None or pairs is not None or not recipe.sheet.captures:
            raise ParameterError(
                "A recipe with [selfsupervised] learns from captures alone: name them, `--captures FOLDER`, "
                "and neither `--photos` nor `--pairs`."
            )
    elif photos is None and pairs is None:
        raise ParameterError(
            "Name what to learn from: photographs, `--photos FOLDER`, or pairs, `--pairs FILE`. "
            "To learn from captures alone, take recipes/selfsupervised.toml."
        )
    elif photos is not None and pairs is not None:
        raise ParameterError(
            f"`--photos` ({photos}) and `--pairs` ({pairs}) exclude each other. Leave one of them out."
        )


def _source(recipe: Recipe, photographs: Photographs, psf: Psf) -> SimulatedPairs:
    return SimulatedPairs(
        photographs,
        psf,
        placement=recipe.placement,
        mismatch=recipe.mismatch,
        sensor=recipe.sensor,
        seed=recipe.schedule.seed,
    )


def _within(recipe: Recipe, most: int) -> Recipe:
    """No recorded pair counts twice in a validation."""
    return replace(recipe, schedule=replace(recipe.schedule, validation=min(recipe.schedule.validation, most)))


def _in_steps(recipe: Recipe, count: int) -> Recipe:
    """Epochs of so many samples become steps: as many of them as hold an epoch, and a validation after each."""
    schedule = recipe.schedule
    if schedule.epochs == 0:
        return recipe
    steps = math.ceil(count / schedule.batch)
    return replace(recipe, schedule=replace(schedule, steps=schedule.epochs * steps, validate_every=steps))
