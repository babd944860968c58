"""Recorded pairs as numbered samples, like the simulated ones; and samples recorded in a file."""

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.calibration.refinement import Refinement
from mwdn.data.pair_checks import check_pairs, missing_refinement
from mwdn.data.pair_writer import Attribute
from mwdn.data.pairs import PairFile, refuse_non_finite
from mwdn.data.simulated import Batch, Samples
from mwdn.data.splits import Split, split
from mwdn.errors import ParameterError
from mwdn.runtime.transfers import to_device
from mwdn.solvers.alignment import align
from mwdn.solvers.pose import Pose
from mwdn.types import Measurement, Psf

HELD_OUT = 20
"""One in this many photographs is held out for validation, or training pairs of a split without a validation part."""

FINGERPRINTED = 2**26
"""Numbers that identify a file of pairs: those of 109 pairs of 320 x 320 in colour, 0.4 s on one slow core."""


@checked
@dataclass(frozen=True)
class Division:
    """The [pairs] of a recipe: which pairs of a file are for training and which for validation.

    Args:
        split: see `mwdn.data.splits.split`. The published ones go by position, so no pair may be missing.
        fractions: of training, validation and test; only for "random" and "in-order".
        seed: only for "random".
        folds: number of parts; only for "folds".
        fold: the part for validation, from 0; only for "folds".
        aligned: align the PSF to each measurement, as `mwdn.Reconstructor` does for a network with ``align``.
        best_gain: the scenes have units of their own: compare after the gain and offset of each colour that fit best.
    """

    split: str = "paper"
    fractions: tuple[float, float, float] = (0.8, 0.1, 0.1)
    seed: int = 0
    folds: int = 4
    fold: int = 0
    aligned: bool = False
    best_gain: bool = False

    def parts(self, count: int) -> Split:
        """Positions of the pairs for "train", "validation" and "test".

        Raises:
            UnknownNameError: no such split.
            ParameterError: it does not fit the count, or leaves no pair for training or validation.
        """
        parts = split(count, self.split, fractions=self.fractions, seed=self.seed, folds=self.folds, fold=self.fold)
        train, validation = parts["train"], parts.get("validation", [])
        if not validation:
            validation = train[HELD_OUT - 1 :: HELD_OUT]
            train = sorted(set(train) - set(validation))
        if not train or not validation:
            raise ParameterError(
                f"The split '{self.split}' of {count:,} pairs leaves {len(train):,} for training and "
                f"{len(validation):,} for validation; both need at least one. Choose other `fractions` in [pairs]."
            )
        return parts | {"train": train, "validation": validation}


@dataclass(frozen=True, eq=False)
class RecordedPairs(Samples):
    """The pairs of a file: each once per epoch, in another order.

    Args:
        file: of the pairs, opened when the first one is read.
        rows: positions of the pairs to use.
        psf: (1, C, H, W), of the camera; its device is where the pairs are put.
        seed: of the orders.
        shuffled: otherwise in the order of ``rows``, repeatedly.
        aligned: align the PSF to each measurement, when it is first read.
        poses: of the aligned PSF, by position in the file.
        refinement: of the camera, for measurements that were imported without it.
    """

    file: PairFile
    rows: range | list[int]
    psf: Psf
    seed: int = 0
    shuffled: bool = True
    aligned: bool = False
    poses: dict[int, Pose] = field(default_factory=dict, repr=False)
    refinement: Refinement = Refinement()

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def name(self) -> str:
        """States the number of pairs, which determines their order."""
        return f"{len(self):,} of {len(self.file):,} recorded"

    @property
    def content(self) -> str:
        """Size and time of modification of the file."""
        status = self.file.path.stat()
        return f"{status.st_size} {status.st_mtime_ns}"

    @property
    def fingerprint(self) -> str:
        """Hash of up to `FINGERPRINTED` numbers: of all pairs of a small file, of 16 or more over a large one."""
        digest, count = hashlib.sha256(), len(self.file)
        size = math.prod(self.file.measurement_shape) + math.prod(self.file.scene_shape)
        most = max(16, FINGERPRINTED // size)
        for row in range(0, count, max(1, -(-count // most))):
            for picture in self.file[row]:
                digest.update(picture.numpy().tobytes())
        return digest.hexdigest()

    def batch(self, numbers: range | list[int]) -> Batch:
        """Read the samples of these numbers.

        Returns:
            measurement and scene, (B, C, H, W) each, linear light, nominally in [0, 1]; and the PSF, of each
            measurement if it is ``aligned``.

        Raises:
            ImageError: a pair cannot be read.
            ParameterError: a pair holds NaN or infinity.
        """
        rows = [self.row(number) for number in numbers]
        pairs = [self.file[row] for row in rows]
        for row, pair in zip(rows, pairs, strict=True):
            refuse_non_finite(pair, row)
        measurement, scene = (to_device(torch.stack(part), self.psf.device) for part in zip(*pairs, strict=True))
        measurement = self.refinement.measurement(measurement)
        if not self.aligned:
            return Batch(measurement, scene, self.psf)
        moved = [self._pose(row, one[None]).move(self.psf) for row, one in zip(rows, measurement, strict=True)]
        return Batch(measurement, scene, torch.cat(moved))

    def _pose(self, row: int, measurement: Measurement) -> Pose:
        if row not in self.poses:
            self.poses[row] = align(measurement, self.psf)
        return self.poses[row]

    def row(self, number: int) -> int:
        """Position of a sample's pair in the file."""
        epoch, place = divmod(number, len(self.rows))
        return self.rows[int(_order(len(self.rows), self.seed, epoch)[place]) if self.shuffled else place]

    def describe(self, numbers: range) -> str:
        """Names the samples with their rows in the file."""
        return f"{super().describe(numbers)}, rows {[self.row(number) for number in numbers]} of the file"

    def prefetched(self, stride: int) -> "PrefetchedPairs":
        """The same pairs, the next batch read while the last one is used."""
        return PrefetchedPairs(self, stride)


@dataclass(frozen=True)
class RefinedPairs:
    """Pairs by index, (C, H, W) each, whose measurements, imported without it, have the camera's refinement."""

    pairs: Any
    refinement: Refinement

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        measurement, scene = self.pairs[index]
        return self.refinement.measurement(measurement[None])[0], scene


class PrefetchedPairs(Samples):
    """Recorded pairs whose next batch is read by another thread.

    Args:
        pairs: to read.
        stride: from the numbers of one batch to those of the next.
    """

    def __init__(self, pairs: RecordedPairs, stride: int) -> None:
        self.pairs, self.stride = pairs, stride
        self._thread = ThreadPoolExecutor(1)
        self._expected: list[int] = []
        self._next = Future[Batch]()

    @property
    def name(self) -> str:
        """The name of the pairs."""
        return self.pairs.name

    @property
    def fingerprint(self) -> str:
        """That of the pairs."""
        return self.pairs.fingerprint

    def batch(self, numbers: range | list[int]) -> Batch:
        """The samples of these numbers, as `RecordedPairs.batch` gives them, with its errors."""
        batch = self._next.result() if list(numbers) == self._expected else self.pairs.batch(numbers)
        self._expected = [number + self.stride for number in numbers]
        self._next = self._thread.submit(self.pairs.batch, self._expected)
        return batch

    def describe(self, numbers: range) -> str:
        """Names the samples with their rows in the file."""
        return self.pairs.describe(numbers)


def recorded_pairs(
    path: Path,
    psf: Psf,
    division: Division,
    *,
    seed: int = 0,
    device: torch.device | str = "cpu",
    refinement: Refinement = Refinement(),
) -> tuple[RecordedPairs, RecordedPairs]:
    """Open a file of pairs for training and for validation.

    Args:
        path: of the file.
        psf: of its camera.
        division: into training and validation.
        seed: of the order in each epoch.
        device: where to put the pairs.
        refinement: of the camera.

    Raises:
        ImageError: no such file, or it is damaged or not a file of pairs.
        ShapeError: the pairs do not fit the PSF.
        ParameterError: the division does not fit the number of pairs.
    """
    file = PairFile(path)
    check_pairs(file, psf)
    parts = division.parts(len(file))
    psf, refinement = psf.to(device), missing_refinement(file, refinement)
    training = RecordedPairs(file, parts["train"], psf, seed, aligned=division.aligned, refinement=refinement)
    return training, replace(training, rows=parts["validation"], shuffled=False, poses={})


def record(
    path: Path,
    parts: Iterable[tuple[Samples, range]],
    psf: Psf,
    *,
    batch: int = 4,
    channels: int = 3,
    attributes: Mapping[str, Attribute] | None = None,
    track: Callable[[list[range]], Iterable[range]] = iter,
) -> None:
    """Write samples to a file of pairs, one part after the other. The file appears when it is complete.

    Args:
        path: of the file, ending in .h5 or .hdf5; an existing one is replaced on success.
        parts: sources, each with the numbers of its samples.
        psf: of the calibration.
        batch: samples to make at once.
        channels: of their measurements and scenes.
        attributes: see `PairFile.create`.
        track: wraps the batches of each part to show progress.

    Raises:
        MwdnError: a sample cannot be made, or the file cannot be written.
    """
    shape = (psf.shape[-2], psf.shape[-1], channels)
    with PairFile.create(path, measurement_shape=shape, scene_shape=shape, attributes=attributes, psf=psf) as file:
        for samples, numbers in parts:
            for chunk in track([numbers[i : i + batch] for i in range(0, len(numbers), batch)]):
                made = samples.batch(chunk)
                file.append(made.measurement.cpu(), made.scene.cpu())


@lru_cache(maxsize=4)
def _order(count: int, seed: int, epoch: int) -> npt.NDArray[np.int64]:
    return np.random.default_rng((seed & (2**63 - 1), epoch)).permutation(count)
