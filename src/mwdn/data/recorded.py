"""Recorded pairs as a source of numbered samples, like the simulated ones."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from mwdn.data.pair_writer import Attribute
from mwdn.data.pairs import PairFile
from mwdn.data.simulated import Pair, Samples
from mwdn.data.splits import split
from mwdn.errors import ParameterError, ShapeError
from mwdn.runtime.transfers import to_device
from mwdn.types import Psf

HELD_OUT = 20
"""Every 20th is held out for validation: of photographs, and of the training pairs of a split without such a part."""


@dataclass(frozen=True)
class Division:
    """Which pairs of a file are for training, and which for validation.

    Args:
        split: see `mwdn.data.splits.split`. The published ones count positions, so that no pair may be missing.
        fractions: of training, validation and test; of "random" only.
        seed: of "random" only.
    """

    split: str = "paper"
    fractions: tuple[float, float, float] = (0.8, 0.1, 0.1)
    seed: int = 0

    def of(self, count: int) -> tuple[range | list[int], range | list[int]]:
        """Positions of the pairs for training and of those for validation; the test part is in neither.

        Raises:
            UnknownNameError: no such split.
            ParameterError: it does not fit the count, or leaves no pair for training.
        """
        parts = split(count, self.split, fractions=self.fractions, seed=self.seed)
        train, validation = parts["train"], parts.get("validation", [])
        if not validation:
            held = train[HELD_OUT - 1 :: HELD_OUT]
            train, validation = sorted(set(train) - set(held)), held
        if not train or not validation:
            raise ParameterError(
                f"The split '{self.split}' of {count:,} pairs leaves {len(train):,} for training and "
                f"{len(validation):,} for validation; both need some. Name other `fractions` in [pairs]."
            )
        return train, validation


@dataclass(frozen=True, eq=False)
class RecordedPairs:
    """A source of the pairs of a file: each once, in another order, in each epoch.

    Args:
        file: of the pairs, opened when the first one is read.
        rows: positions of those to use.
        seed: of the orders.
        shuffled: in the order of ``rows`` otherwise, over and over.
        device: where to put the pairs.
    """

    file: PairFile
    rows: range | list[int]
    seed: int = 0
    shuffled: bool = True
    device: torch.device = torch.device("cpu")  # noqa: RUF009

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def name(self) -> str:
        """Says how many there are, on which the order depends."""
        return f"{len(self):,} of {len(self.file):,} recorded"

    def batch(self, numbers: range | list[int]) -> Pair:
        """Read the samples of these numbers.

        Returns:
            measurement and scene, (B, C, H, W) each, linear light, nominally in [0, 1].

        Raises:
            ImageError: a pair cannot be read.
        """
        pairs = [self.file[self.row(number)] for number in numbers]
        measurement, scene = (to_device(torch.stack(part), self.device) for part in zip(*pairs, strict=True))
        return Pair(measurement, scene)

    def row(self, number: int) -> int:
        """Position in the file of a sample."""
        epoch, place = divmod(number, len(self.rows))
        return self.rows[int(_order(len(self.rows), self.seed, epoch)[place]) if self.shuffled else place]


class ReadAhead:
    """Recorded pairs, of which the next batch is read while whoever took the last one works.

    Args:
        pairs: to be read.
        stride: from a batch's numbers to those of the next.
    """

    def __init__(self, pairs: RecordedPairs, stride: int) -> None:
        self.pairs, self.stride = pairs, stride
        self._thread = ThreadPoolExecutor(1)
        self._expected: range | None = None
        self._next = Future[Pair]()

    def batch(self, numbers: range) -> Pair:
        """Samples of these numbers, as `RecordedPairs.batch` reads them; its errors are raised where they are taken."""
        found = self._next.result() if numbers == self._expected else self.pairs.batch(numbers)
        self._expected = range(numbers.start + self.stride, numbers.stop + self.stride)
        self._next = self._thread.submit(self.pairs.batch, self._expected)
        return found


def recorded_pairs(
    path: Path, psf: Psf, division: Division, *, seed: int = 0, device: torch.device | str = "cpu"
) -> tuple[RecordedPairs, RecordedPairs]:
    """Pairs for training and for validation.

    Args:
        path: of the file.
        psf: of the camera that took them.
        division: which are for what.
        seed: of the order in each epoch.
        device: where to put them.

    Raises:
        ImageError: no such file; damaged, or something else than pairs.
        ShapeError: the pairs do not fit the PSF.
        ParameterError: the division does not fit their number.
    """
    file = PairFile(path)
    check_pairs(file, psf)
    train, validation = division.of(len(file))
    place = torch.device(device)
    return RecordedPairs(file, train, seed, device=place), RecordedPairs(file, validation, seed, False, place)


def check_pairs(file: PairFile, psf: Psf) -> None:
    """See that a file's pairs are of a camera with this PSF.

    Raises:
        ShapeError: another size or other channels.
    """
    (h, w, channels), (H, W), colours = file.measurement_shape, psf.shape[-2:], psf.shape[1]
    if (h, w) != (H, W):
        factor = H // h
        way_out = "Use the PSF of the camera that took them, cropped and binned as they are: `--crop`, `--psf-bin`."
        if factor > 1 and (h * factor, w * factor) == (H, W):
            way_out = f"The PSF is {factor} times as large: bin it by {factor} times as much, `--psf-bin`."
        raise ShapeError(f"`psf` ({H} x {W}) and the measurements of `{file.path}` ({h} x {w}) must match. {way_out}")
    if colours not in (1, channels):
        raise ShapeError(
            f"`psf` ({colours} channels) must be grey, or have the channels of the measurements of `{file.path}` "
            f"({channels}). Calibrate in the mode in which they were taken."
        )
    if file.scene_shape[:2] != (h, w):
        (a, b) = file.scene_shape[:2]
        raise ShapeError(
            f"The scenes of `{file.path}` ({a} x {b}) must have the size of its measurements ({h} x {w}). "
            "Make the file again with scenes of that size: `mwdn import --scene-size`."
        )


def other_camera(file: PairFile, psf_hash: str) -> str | None:
    """Say so, if a file's pairs are of another PSF than the one of this hash."""
    known = file.attributes.get("psf_hash")
    if known in (None, psf_hash):
        return None
    return (
        f"`{file.path}` holds pairs of the camera of PSF {known}, but the PSF given is {psf_hash}. Expect blur, ghosts "
        "and low numbers, unless both are of one camera; another crop, binning or background of one PSF file counts as "
        "another PSF."
    )


def record(
    path: Path,
    parts: Iterable[tuple[Samples, range]],
    psf: Psf,
    *,
    batch: int = 4,
    attributes: Mapping[str, Attribute] | None = None,
    track: Callable[[list[range]], Iterable[range]] = iter,
) -> None:
    """Write samples to a file of pairs, one part after the other; the file is there only once it is whole.

    Args:
        path: of the file, ending in .h5 or .hdf5; one that exists is replaced when all has gone well.
        parts: sources, and the numbers of their samples.
        psf: of the calibration.
        batch: samples that are made at once.
        attributes: see `PairFile.create`.
        track: shows the progress of each part.

    Raises:
        MwdnError: a sample cannot be made, or the file cannot be written.
    """
    shape = (psf.shape[-2], psf.shape[-1], 3)
    with PairFile.create(path, measurement_shape=shape, scene_shape=shape, attributes=attributes, psf=psf) as file:
        for samples, numbers in parts:
            for some in track([numbers[i : i + batch] for i in range(0, len(numbers), batch)]):
                measurement, scene, _ = samples.batch(some)
                file.append(measurement.cpu(), scene.cpu())


@lru_cache(maxsize=4)
def _order(count: int, seed: int, epoch: int) -> npt.NDArray[np.int64]:
    return np.random.default_rng((seed & (2**63 - 1), epoch)).permutation(count)
