"""Data sets of a benchmark: simulated or recorded pairs, divided into training, validation and test."""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from mwdn.calibration import Calibration, FrameFormat
from mwdn.calibration.psf_identity import psf_identity
from mwdn.calibration.refinement import Refinement
from mwdn.data.importers import import_pairs
from mwdn.data.kinds import KINDS, Layout
from mwdn.data.mismatch import EXACT, Mismatch
from mwdn.data.pair_checks import REFINED, check_pairs, missing_refinement
from mwdn.data.pair_writer import Attribute
from mwdn.data.pairs import PairFile, Part
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import HELD_OUT, Division, RecordedPairs, RefinedPairs, record
from mwdn.data.simulated import Placement, Samples, SimulatedPairs
from mwdn.errors import ParameterError
from mwdn.evaluation import Protocol
from mwdn.io.files import write_text
from mwdn.io.reading import read_json
from mwdn.optics import Deviation, Sensor
from mwdn.training.experiment import FILE_START, simulated_sensor
from mwdn.training.validation import START

Track = Callable[[str, list[range]], Iterable[range]]
"""Shows the progress of an iteration under a title."""


@dataclass(frozen=True)
class DatasetRecipe:
    """Pairs of one camera: simulated from photographs, or recorded.

    Args:
        camera: camera file of `mwdn calibrate`, for the settings of the camera that are not given here.
        psf: of the calibration, a file.
        bin: average blocks of so many pixels of the PSF and of captures; the protocol shrinks with them.
        psf_bin: of the PSF besides, where it was taken at so many times the resolution of the captures; 0 for that of
            the camera file.
        background: even light under the PSF, as a part of the full scale; estimated if negative.
        upside_down: files have their first row at the bottom.
        bgr: files have their channels in the order blue, green, red.
        photos: folder to simulate training from; every 20th photograph is for validation.
        test_photos: folder to simulate the test from.
        train: pairs to train on that are made once; 0 makes every sample a new one.
        validation: pairs to choose the best weights by.
        test: pairs to be scored on; of recorded ones at most so many, 0 for all.
        seed: of all that is simulated.
        placement: how a photograph stands in the scene.
        deviation: how the true camera differs from its calibration, which is all that methods are told.
        mismatch: the same, drawn anew for each pair, in place of one true camera; see `mwdn.data.mismatch.Mismatch`.
        sensor: its noise; that of the camera file unless given.
        pairs: recorded ones in place of photographs: a file of ``mwdn import``, or a data set of this ``kind``.
        kind: how they are laid out, see `mwdn.data.kinds.KINDS`; empty for a file of pairs.
        split: which are for what, see `mwdn.data.splits.split`; empty if all are for the test.
        trained_on: another data set, of the same camera, whose networks are tested here; nothing is trained.
        captures: real ones without a scene, files and folders, to be shown.
        protocol: the part of each picture that counts, in pixels before ``bin``.
    """

    camera: str = ""
    psf: str = ""
    bin: int = 1
    psf_bin: int = 1
    background: float = -1.0
    upside_down: bool = False
    bgr: bool = False
    photos: str = ""
    test_photos: str = ""
    train: int = 1000
    validation: int = 16
    test: int = 24
    seed: int = 0
    placement: Placement = Placement()
    deviation: Deviation = Deviation()
    mismatch: Mismatch = EXACT
    sensor: Sensor = Sensor()
    pairs: str = ""
    kind: str = ""
    split: str = ""
    trained_on: str = ""
    captures: tuple[str, ...] = ()
    protocol: str = "full"

    def binned_protocol(self) -> Protocol:
        """The protocol at the size of the binned pictures: "centre-128" binned by 2 is "centre-64"."""
        whole = Protocol.parse(self.protocol)
        if whole.centre:
            return Protocol.parse(f"centre-{whole.centre // self.bin}")
        if whole.rows and whole.columns:
            (top, bottom), (left, right) = whole.rows, whole.columns
            top, bottom, left, right = (number // self.bin for number in (top, bottom, left, right))
            return Protocol.parse(f"{top}:{bottom},{left}:{right}")
        return whole

    def calibration(self) -> Calibration:
        """Read the PSF."""
        options: dict[str, Any] = {"bin": self.bin, "bgr": self.bgr, "upside_down": self.upside_down}
        options["background"] = self.background if self.background >= 0 else "estimate"
        if self.psf_bin:
            options["psf_bin"] = self.bin * self.psf_bin
        if not self.camera:
            return Calibration.from_file(self.psf, **options)
        # Reconstructions are compared with scenes in the camera's colours.
        return replace(Calibration.load(self.camera, psf=Path(self.psf), **options), white_balance=None)


_PAPER = DatasetRecipe(protocol="centre-128")
_DIFFUSERCAM = DatasetRecipe(background=0.0, upside_down=True, bgr=True, protocol="60:270,60:440")
_PHLATCAM = DatasetRecipe(background=0.0)
_REAL = Deviation(turn_degrees=0.5, background=0.1, off_axis=1.0)

PRESETS: dict[str, DatasetRecipe] = {
    # The display took 137 of 320 pixels, 2.5 of the 91.5 beside it off the centre.
    "mwdn-sim": replace(_PAPER, placement=Placement((0.428, 0.428), 1.0, 0.0, 0.027), deviation=_REAL),
    # Scenes of many sizes about the 210 x 380 that its display filled; the noise explains its captures.
    "diffusercam-sim": replace(
        _DIFFUSERCAM,
        placement=Placement((0.7, 1.5), 1.6, 5.0, 0.8),
        deviation=replace(_REAL, turn_degrees=0.3),
        sensor=Sensor(5000.0, 7.0),
    ),
    # Scenes of 384 x 384 in the middle of 384 x 640: their position is not published.
    "phlatcam-sim": replace(
        _PHLATCAM, placement=Placement((1.0, 1.0), 1.0, 0.0, 0.0), deviation=_REAL, protocol="0:384,128:512"
    ),
    "diffusercam-real": replace(_DIFFUSERCAM, kind="diffusercam", trained_on="diffusercam-sim", test=0),
    # The public sets in their own layouts, and their own splits.
    "mwdn": replace(_PAPER, kind="mwdn", split="paper", test=0),
    "diffusercam": replace(_DIFFUSERCAM, kind="diffusercam", split="diffusercam", validation=2500, test=0),
    "diffusercam-paper": replace(_DIFFUSERCAM, kind="diffusercam", split="paper", validation=2500, test=0),
    "phlatcam": replace(_PHLATCAM, kind="phlatcam", split="phlatcam", test=0),
}
"""Presets of the paper's data sets; a recipe names the files, and may replace any value."""


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
    own = simulates or recipe.kind  # else the user's file, which is only read
    path = folder / f"{name}.h5" if own else Path(recipe.pairs)
    made = read_json(note) if own and note.is_file() and path.is_file() else None
    if made not in (None, identity):
        raise ParameterError(
            f"`{path}` holds pairs that another recipe made. Choose another folder, `out`, or remove it."
        )
    if own and made is None:
        if simulates:
            _simulate(recipe, calibration, path, device, lambda rows: track(f"{name}: simulating", rows))
        else:
            resized = (recipe.camera or recipe.bin > 1) and KINDS[recipe.kind].place is None
            layout = Layout(scene_size=calibration.size if resized else None)
            frames = calibration.frames if recipe.camera else FrameFormat(bin=recipe.bin)
            import_pairs(recipe.kind, recipe.pairs, path, layout=layout, frames=frames)
        write_text(note, json.dumps(identity, indent=2))
    file = PairFile(path)
    check_pairs(file, calibration.psf)
    rows = _rows(recipe, len(file), simulates)
    refinement = Refinement() if simulates else missing_refinement(file, calibration.refinement)
    pairs = partial(RecordedPairs, file, psf=calibration.psf.to(device), seed=recipe.seed, refinement=refinement)
    training = None if recipe.trained_on else _training(recipe, calibration, pairs, rows, device)
    test = RefinedPairs(Part(file, rows["test"]), refinement)
    return Dataset(name, recipe, calibration, test, training, identity, file.measurement_shape[2])


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
    return json.loads(json.dumps({**identity, "psf_hash": calibration.psf_hash}))


def simulated_pairs(
    recipe: DatasetRecipe, calibration: Calibration, photographs: Photographs, device: torch.device
) -> SimulatedPairs:
    """The source of a data set's simulated pairs."""
    psf = calibration.psf.to(device)
    return SimulatedPairs(
        photographs.to(device),
        psf,
        placement=recipe.placement,
        mismatch=recipe.mismatch,
        sensor=recipe.sensor,
        seed=recipe.seed,
        camera=recipe.deviation.camera(psf) if recipe.mismatch == EXACT else None,
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
    parts = [
        (simulated_pairs(recipe, calibration, photographs, device), range(start, start + count))
        for photographs, start, count in (
            (learned, 0, recipe.train),
            (held_out, START, recipe.validation),
            (Photographs(recipe.test_photos), FILE_START, recipe.test),
        )
    ]
    attributes: dict[str, Attribute] = {**psf_identity(calibration), "seed": recipe.seed, REFINED: "simulate"}
    channels = 1 if calibration.frames.grey else 3
    record(path, parts, calibration.psf, channels=channels, attributes=attributes, track=track)


def _rows(recipe: DatasetRecipe, count: int, simulates: bool) -> dict[str, range | list[int]]:
    if simulates:
        first, second = recipe.train, recipe.train + recipe.validation
        return {"train": range(first), "validation": range(first, second), "test": range(second, count)}
    if not recipe.split:
        return {"test": range(min(recipe.test or count, count))}
    parts = Division(recipe.split, seed=recipe.seed).parts(count)
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
