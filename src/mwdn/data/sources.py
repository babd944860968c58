"""List the pairs of a public data set and read them one by one: one function per layout."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mwdn.calibration import FrameFormat
from mwdn.data.hdf5 import as_damage, find_rows, names_in, open_hdf5
from mwdn.data.pair_checks import refuse_raw
from mwdn.data.pairs import PairFile
from mwdn.data.shards import Shard, find_shards, natural_order
from mwdn.errors import ImageError
from mwdn.io.headers import COPY_AGAIN
from mwdn.io.images import READABLE, read_frame
from mwdn.io.listing import FRAMES, pictures_in
from mwdn.io.raw import Mosaic
from mwdn.types import Frame

MAX_ROWS = 2**21
"""Most pairs of one file: listing them takes 0.7 GB."""

# The ten ImageNet classes on which FlatNet's authors tested. The data set has ten pictures of each class, so these are
# its 100 test pairs. From `val_target.txt` of their code (S. S. Khan et al., TPAMI 44, 1934, 2022).
PHLATCAM_TEST = frozenset(
    {
        "n01818515",
        "n01820546",
        "n02165456",
        "n02870880",
        "n02871525",
        "n02980441",
        "n03785016",
        "n06874185",
        "n07747607",
        "n09193705",
    }
)


class Stored(NamedTuple):
    """A pair as it is stored.

    Args:
        capture: (H, W, C).
        scene: (H, W, C).
        mosaic: colours of the capture's 2 x 2 cells, as its raw file states them.
    """

    capture: Frame
    scene: Frame
    mosaic: Mosaic | None = None


@dataclass(frozen=True)
class Source:
    """One pair that has not been read yet.

    Args:
        name: a file's stem, or a row.
        load: reads the pair, or raises `ImageError`.
        mask: label of the mask, for a camera with several.
    """

    name: str
    load: Callable[[], Stored]
    mask: str = ""


@dataclass(frozen=True)
class Listing:
    """The pairs of a data set, in its order, and the reason for each file or row that cannot be used, by its name."""

    sources: list[Source]
    refused: dict[str, str] = field(default_factory=dict)


def list_folders(path: Path, captures: str, scenes: str) -> Listing:
    """Pair the pictures of two folders and their subfolders by stem, in natural order (im2 before im10).

    Args:
        path: of the data set.
        captures: folder of the measurements in ``path``; they may be a camera's raw files.
        scenes: folder of the ground truth in ``path``.

    Raises:
        ImageError: a folder is missing or named twice, or two files differ only in their suffix.
    """
    if not path.is_dir():
        raise ImageError(f"`{path}` is not a folder. Check its path.")
    if (path / captures).resolve() == (path / scenes).resolve():
        raise ImageError(
            f"`{path / captures}` is the folder of both captures and scenes. Name two: `--captures A --scenes B`."
        )
    files = {captures: files_by_stem(path / captures, FRAMES), scenes: files_by_stem(path / scenes)}
    stems = sorted(set(files[captures]) | set(files[scenes]), key=natural_order)
    refused, sources = {}, []
    for stem in stems:
        missing = [folder for folder in (captures, scenes) if stem not in files[folder]]
        if missing:
            present = next(paths[stem] for paths in files.values() if stem in paths)
            refused[stem] = f"`{present}` has no partner in `{path / missing[0]}`. Add it, or remove this one."
        else:
            sources.append(Source(stem, partial(read_both, files[captures][stem], files[scenes][stem])))
    return Listing(sources, refused)


def list_phlatcam(path: Path, captures: str, scenes: str) -> Listing:
    """`list_folders`, with the ten classes of the test set at the end."""
    listing = list_folders(path, captures, scenes)
    sources = sorted(listing.sources, key=lambda source: source.name.split("/")[0] in PHLATCAM_TEST)
    return Listing(sources, listing.refused)


def list_hdf5(path: Path, captures: str, scenes: str) -> Listing:
    """List the rows of the authors' HDF5 file: two data sets (N, C, H, W) of uint8.

    Raises:
        ImageError: not HDF5, cut off, or without these data sets.
    """
    file = open_hdf5(path, COPY_AGAIN)
    for name in (captures, scenes):
        data = find_rows(path, file, name, COPY_AGAIN)
        if data is None:
            raise ImageError(
                f"`{path}` must have `{name}`, (N, 3, H, W) of uint8, but has {names_in(path, file)}. "
                "Name the data sets: `--captures blur --scenes gt`."
            )
        if data.ndim != 4 or data.shape[1] not in (1, 3) or data.dtype != "u1":
            raise ImageError(
                f"`{name}` of `{path}` must be (N, 3, H, W) of uint8, not {data.shape} of {data.dtype}. Convert it, or "
                "write its pictures to two folders: `mwdn import folders`."
            )
    counts = [len(file[name]) for name in (captures, scenes)]
    complete = min(counts)
    if max(counts) > MAX_ROWS:
        raise ImageError(f"`{path}` claims {max(counts):,} pairs; at most {MAX_ROWS:,} are imported. Divide it.")
    refused = {
        f"row {row}": f"Row {row} of `{path}` is in one of `{captures}` ({counts[0]:,}) and `{scenes}` ({counts[1]:,})"
        f" only. {COPY_AGAIN}"
        for row in range(complete, max(counts))
    }
    return Listing(
        [Source(f"row {row}", partial(_read_row, path, file, (captures, scenes), row)) for row in range(complete)],
        refused,
    )


def list_pair_file(path: Path, captures: str, scenes: str) -> Listing:
    """List the pairs of a file of this package, (N, H, W, C): `PairFile`.

    Raises:
        ImageError: no such file, or not one of pairs.
        ParameterError: it holds a session's raw frames.
    """
    pairs = PairFile(path)  # raises if it is not a file of pairs
    refuse_raw(pairs)
    count = len(pairs)
    file = open_hdf5(path, COPY_AGAIN)

    def load(row: int) -> Stored:
        with as_damage(f"Pair {row} of `{path}` cannot be read", COPY_AGAIN):
            return Stored(file[captures][row], file[scenes][row])

    return Listing([Source(f"pair {row}", partial(load, row)) for row in range(count)])


def list_parquet(path: Path, captures: str, scenes: str) -> Listing:
    """List the rows of parquet shards, as on the Hugging Face hub, whose columns hold encoded pictures.

    Args:
        path: a shard, a folder of shards, or a name on the hub such as ``owner/name``.
        captures: column of the measurements.
        scenes: column of the ground truth.

    Raises:
        MissingPackageError: ``pyarrow`` (for the hub ``huggingface_hub``) is not installed.
        ImageError: nothing there.
    """
    shards = find_shards(path)
    sources: list[Source] = []
    refused = {}
    for shard in shards:
        try:
            rows = Shard(shard, (captures, scenes))
        except ImageError as error:
            refused[shard.name] = str(error)
            continue
        sources += [Source(f"{shard.name} row {row}", partial(_read_cells, rows, row)) for row in range(rows.count)]
    return Listing(sources, refused)


def _read_cells(shard: Shard, row: int) -> Stored:
    capture, scene = shard.load(row)
    return Stored(capture, scene)


def files_by_stem(folder: Path, suffixes: frozenset[str] = READABLE) -> dict[str, Path]:
    """Files with these suffixes in a folder and its subfolders, by their path without suffix.

    Raises:
        ImageError: no such folder, or two files differ only in their suffix.
    """
    if not folder.is_dir():
        raise ImageError(
            f"`{folder}` is not a folder. Name the folders inside the data set: `--captures A --scenes B`."
        )
    paths: dict[str, Path] = {}
    for file in pictures_in(folder, suffixes):
        stem = file.relative_to(folder).with_suffix("").as_posix()
        if stem in paths:
            raise ImageError(f"`{paths[stem]}` and `{file}` differ only in their suffix. Remove one of them.")
        paths[stem] = file
    return paths


def read_both(capture: Path, scene: Path) -> Stored:
    """Read a capture as the sensor stored it, and its scene as it is to be shown."""
    frame, stated = FrameFormat().read_stored(capture)
    return Stored(frame, read_frame(scene, upright=True), stated.mosaic)


def _read_row(path: Path, file: Any, names: tuple[str, str], row: int) -> Stored:  # noqa: ANN401
    with as_damage(f"Row {row} of `{path}` cannot be read", COPY_AGAIN):
        capture, scene = (np.moveaxis(file[name][row], 0, -1) for name in names)
        return Stored(capture, scene)
