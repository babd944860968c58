"""What a user does with a recipe, a calibration and a folder of photographs: train, or make a file of pairs."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from mwdn.calibration import Calibration
from mwdn.data.pair_writer import Attribute
from mwdn.data.pairs import PairFile
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import EXACT, SimulatedPairs
from mwdn.errors import ParameterError
from mwdn.learning import distributed
from mwdn.learning.recipe import Recipe
from mwdn.learning.train import Trainer
from mwdn.types import Psf

HELD_OUT = 20
"""Every 20th photograph is for validation."""

FILE_START = 2 * 10**12
"""Number of the first sample of a file: a network trained with the same seed has seen none of them."""


def prepare(recipe: Recipe, calibration: Calibration, photos: Path, out: Path, device: str | None = None) -> Trainer:
    """Read the photographs and set the run up.

    Args:
        recipe: the experiment.
        calibration: of the camera.
        photos: folder of photographs; every 20th is held out for validation.
        out: folder of the run.
        device: a GPU if there is one unless given.

    Raises:
        MwdnError: torch cannot use the device, a photograph cannot be read, or the folder holds another run.
    """
    place = distributed.device_here(device)
    training, validation = Photographs(photos).to(place).split(HELD_OUT)
    pairs = _source(recipe, training, calibration.psf.to(place))
    return Trainer(recipe, calibration, pairs, out, validation=replace(pairs, photographs=validation), device=place)


def simulate(
    recipe: Recipe,
    calibration: Calibration,
    photos: Path,
    out: Path,
    count: int,
    *,
    exact: bool = False,
    track: Callable[[range], Iterable[int]] = iter,
) -> None:
    """Write simulated pairs to a file, which is there only once it is whole.

    Args:
        recipe: its placement, mismatch, sensor and seed are used.
        calibration: of the camera.
        photos: folder of photographs.
        out: the file of pairs; one that exists is replaced when all has gone well.
        count: of pairs.
        exact: the camera is what its calibration says, whatever the recipe's mismatch.
        track: shows the progress of an iteration.

    Raises:
        MwdnError: ``count`` is not positive, a photograph cannot be read, or the file cannot be written.
    """
    if count < 1:
        raise ParameterError(f"`count` ({count}) must be at least 1.")
    pairs = _source(recipe, Photographs(photos), calibration.psf)
    pairs = replace(pairs, mismatch=EXACT) if exact else pairs
    attributes: dict[str, Attribute] = {"psf_hash": calibration.psf_hash, "seed": pairs.seed}
    shape = (*calibration.size, 3)
    file = PairFile.create(out, measurement_shape=shape, scene_shape=shape, attributes=attributes, psf=calibration.psf)
    with file:
        for start in track(range(0, count, recipe.schedule.batch)):
            end = min(start + recipe.schedule.batch, count)
            file.append(*pairs.batch(range(FILE_START + start, FILE_START + end)))


def _source(recipe: Recipe, photographs: Photographs, psf: Psf) -> SimulatedPairs:
    return SimulatedPairs(
        photographs,
        psf,
        placement=recipe.placement,
        mismatch=recipe.mismatch,
        sensor=recipe.sensor,
        seed=recipe.schedule.seed,
    )
