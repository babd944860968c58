"""Data sets of a benchmark: simulated or recorded pairs, divided into training, validation and test."""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

from mwdn.benchmark.dataset_recipe import DatasetRecipe
from mwdn.calibration import Calibration, FrameFormat
from mwdn.calibration.places import field_camera
from mwdn.calibration.psf_identity import psf_identity
from mwdn.calibration.refinement import Refinement
from mwdn.data.captures import find_captures, read_captures
from mwdn.data.importers import import_pairs
from mwdn.data.kinds import KINDS, Layout
from mwdn.data.mismatch import EXACT
from mwdn.data.pair_checks import REFINED, check_pairs, missing_refinement
from mwdn.data.pair_writer import Attribute
from mwdn.data.pairs import PairFile, Part
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import HELD_OUT, RecordedPairs, RefinedPairs, record
from mwdn.data.simulated import Samples, SimulatedPairs
from mwdn.errors import ParameterError
from mwdn.evaluation import Protocol
from mwdn.io.files import write_text
from mwdn.io.reading import read_json
from mwdn.optics import Deviation, FieldCamera
from mwdn.optics.psf import psf_hash
from mwdn.training.experiment import FILE_START, simulated_sensor
from mwdn.training.validation import VALIDATION_START
from mwdn.types import Measurement

CAPTURES = 6
"""Maximum number of real captures on the page."""

Track = Callable[[str, list[range]], Iterable[range]]
"""Shows the progress of an iteration under a title."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """A data set with its files made and open.

    Args:
        name: as in the recipe.
        recipe: its table in the recipe.
        calibration: of its camera, as the methods get it.
        test: pairs to score on.
        training: training and validation pairs; ``None`` if the networks of another data set are tested.
        identity: the settings that its pairs depend on, in values that JSON can hold.
        channels: of measurements and scenes, 1 for a grey camera.
    """

    name: str
    recipe: DatasetRecipe
    calibration: Calibration
    test: RefinedPairs
    training: tuple[Samples, RecordedPairs] | None
    identity: dict[str, Any]
    channels: int = 3

    @property
    def protocol(self) -> Protocol:
        """The part of each picture that is scored."""
        return self.recipe.binned_protocol()

    @cached_property
    def captures(self) -> Measurement:
        """The first `CAPTURES` real captures, (N, C, H, W); N is 0 if there are none.

        Raises:
            MwdnError: one cannot be read, or does not fit the camera.
        """
        files = find_captures(self.recipe.captures)[:CAPTURES] if self.recipe.captures else []
        return read_captures(files, self.calibration) if files else torch.zeros(0, 3, *self.calibration.size)


def open_dataset(name: str, recipe: DatasetRecipe, folder: Path, device: torch.device, track: Track) -> Dataset:
    """Make a data set's file of pairs, unless it is there, and open it.

    Args:
        name: of the data set.
        recipe: its table in the recipe.
        folder: for its files.
        device: where to simulate, and where training takes place.
        track: shows progress.

    Raises:
        MwdnError: a file cannot be read, or does not fit the camera; or ``folder`` holds other pairs of this name.
    """
    calibration = recipe.calibration()
    recipe.binned_protocol().crop(calibration.psf)  # refuses a part that does not fit before anything is trained
    simulates = not recipe.pairs
    if simulates:
        recipe = replace(recipe, sensor=simulated_sensor(recipe.sensor, calibration))
    identity = _identity(recipe, calibration)
    note = folder / f"{name}.json"
    own = simulates or bool(recipe.kind)  # else the user's file, which is only read
    path = folder / f"{name}.h5" if own else Path(recipe.pairs)
    if own and not _is_made(path, note, identity):
        if simulates:
            _simulate(recipe, calibration, path, device, lambda rows: track(f"{name}: simulating", rows))
        else:
            _import(recipe, calibration, path)
        write_text(note, json.dumps(identity, indent=2))
    file = PairFile(path)
    check_pairs(file, calibration.psf)
    rows = _rows(recipe, len(file), simulates)
    refinement = Refinement() if simulates else missing_refinement(file, calibration.refinement)
    pairs = partial(RecordedPairs, file, psf=calibration.psf.to(device), seed=recipe.seed, refinement=refinement)
    if not own:
        _refuse_changed(path, note, pairs(rows["test"]).fingerprint)
    training = None if recipe.trained_on else _training(recipe, calibration, pairs, rows, device)
    test = RefinedPairs(Part(file, rows["test"]), refinement)
    return Dataset(name, recipe, calibration, test, training, identity, file.measurement_shape[2])


def _refuse_changed(path: Path, note: Path, fingerprint: str) -> None:
    """Raise a `ParameterError` if a user's file had other pairs when the benchmark began; note those of a new one."""
    content = {"pairs": fingerprint}
    if not note.is_file():
        write_text(note, json.dumps(content))
    elif read_json(note) != content:
        raise ParameterError(
            f"`{path}` holds other pairs than those that `{note.parent.parent}` has results of. Choose another folder, "
            "`out`, or remove it."
        )


def _is_made(path: Path, note: Path, identity: dict[str, Any]) -> bool:
    """Whether a file of pairs is there, of this identity, which is in a note beside it.

    Raises:
        ParameterError: it is of another one.
    """
    made = read_json(note) if note.is_file() and path.is_file() else None
    if made not in (None, identity):
        raise ParameterError(
            f"`{path}` holds pairs that another recipe made. Choose another folder, `out`, or remove it."
        )
    return made is not None


def _identity(recipe: DatasetRecipe, calibration: Calibration) -> dict[str, Any]:
    """The settings that the pairs of a data set depend on, in values that JSON can hold."""
    not_in_pairs = {"camera", "psf", "captures", "protocol"}
    not_in_pairs |= {"mismatch"} if recipe.mismatch == EXACT else set()  # earlier files lack it
    identity = {key: value for key, value in asdict(recipe).items() if key not in not_in_pairs}
    if recipe.camera:
        identity["frames"] = repr(calibration.frames)
    if calibration.frames.grey and not recipe.pairs:
        identity["channels"] = 1  # earlier pairs of grey cameras have colours
    if calibration.refinement and recipe.pairs:
        identity["refinement"] = repr(calibration.refinement)
    identity |= _parts_of_camera(recipe, calibration)
    return json.loads(json.dumps({**identity, "psf_hash": calibration.psf_hash}))


def _parts_of_camera(recipe: DatasetRecipe, calibration: Calibration) -> dict[str, str]:
    """Hashes of the files of a camera, beside its PSF, that its pairs depend on; earlier pairs did not."""
    if recipe.kind and recipe.camera:
        corrections = calibration.corrections
        parts = {"subtracted": calibration.offset, "flat": corrections.flat, "hot_pixels": corrections.defects}
        return {key: "none" if part is None else psf_hash(part) for key, part in parts.items()}
    if calibration.places.field_psfs and not recipe.pairs:
        return {"field": psf_hash(_field(recipe, calibration).kernels)}
    return {}


def _field(recipe: DatasetRecipe, calibration: Calibration) -> FieldCamera:
    """The camera whose PSF changes over the field as measured.

    Raises:
        ParameterError: the recipe makes it differ in another way, too.
    """
    if recipe.deviation != Deviation() or recipe.mismatch != EXACT:
        raise ParameterError(
            "A camera with `field_psfs` differs from its calibration as measured, not by `deviation` or `mismatch`. "
            "Leave these out, set the deviation of a preset to 0, or remove `field_psfs` and `field_positions` from "
            "the camera file."
        )
    return field_camera(calibration)


def simulated_pairs(
    recipe: DatasetRecipe, calibration: Calibration, photographs: Photographs, device: torch.device
) -> SimulatedPairs:
    """The source of a data set's simulated pairs."""
    psf = calibration.psf.to(device)
    camera = recipe.deviation.camera(psf) if recipe.mismatch == EXACT else None
    if calibration.places.field_psfs:
        camera = _field(recipe, calibration).to(device)
    return SimulatedPairs(
        photographs.to(device),
        psf,
        placement=recipe.placement,
        mismatch=recipe.mismatch,
        sensor=recipe.sensor,
        seed=recipe.seed,
        camera=camera,
        grey=calibration.frames.grey,
    )


def _simulate(
    recipe: DatasetRecipe,
    calibration: Calibration,
    path: Path,
    device: torch.device,
    track: Callable[[list[range]], Iterable[range]],
) -> None:
    """Training, validation and test, in this order, from three sets of photographs that share none."""
    learned, held_out = Photographs(recipe.photos).split(HELD_OUT)
    source = simulated_pairs(recipe, calibration, learned, device)
    parts = [
        (replace(source, photographs=photographs.to(device)), range(start, start + count))
        for photographs, start, count in (
            (learned, 0, recipe.train),
            (held_out, VALIDATION_START, recipe.validation),
            (Photographs(recipe.test_photos), FILE_START, recipe.test),
        )
    ]
    attributes: dict[str, Attribute] = {**psf_identity(calibration), "seed": recipe.seed, REFINED: "simulate"}
    channels = 1 if calibration.frames.grey else 3
    record(path, parts, calibration.psf, channels=channels, attributes=attributes, track=track)


def _import(recipe: DatasetRecipe, calibration: Calibration, path: Path) -> None:
    """Convert a public data set, in the format of the recipe's camera if it names one, otherwise in the recipe's."""
    is_resized = (recipe.camera or recipe.bin > 1) and KINDS[recipe.kind].place is None
    layout = Layout(scene_size=calibration.size if is_resized else None)
    camera = calibration if recipe.camera else None
    own = FrameFormat(bin=recipe.bin, bgr=recipe.bgr, upside_down=recipe.upside_down)
    frames = camera.frames if camera else own
    import_pairs(recipe.kind, recipe.pairs, path, layout=layout, frames=frames, camera=camera)


def _rows(recipe: DatasetRecipe, count: int, simulates: bool) -> dict[str, range | list[int]]:
    if simulates:
        first, second = recipe.train, recipe.train + recipe.validation
        return {"train": range(first), "validation": range(first, second), "test": range(second, count)}
    if not recipe.split:
        return {"test": range(min(recipe.test or count, count))}
    parts = recipe.division().parts(count)
    if not parts["test"]:
        raise ParameterError(
            f"`split` ({recipe.split}) of {count:,} pairs must have a test part, to score the methods."
        )
    lengths = {"train": None, "validation": recipe.validation, "test": recipe.test or None}
    return {name: parts[name][:length] for name, length in lengths.items()}


def _training(
    recipe: DatasetRecipe,
    calibration: Calibration,
    pairs: Callable[..., RecordedPairs],
    rows: dict[str, range | list[int]],
    device: torch.device,
) -> tuple[Samples, RecordedPairs]:
    validation = pairs(rows["validation"], shuffled=False)
    if not recipe.pairs and not recipe.train:
        return simulated_pairs(recipe, calibration, Photographs(recipe.photos).split(HELD_OUT)[0], device), validation
    return pairs(rows["train"]), validation
