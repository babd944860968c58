"""List the pairs of a public data set and read them one by one: one function per layout."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.data.hdf5 import as_damage, find_rows, names_in, open_hdf5
from mwdn.errors import ImageError
from mwdn.io.images import READABLE, decode_frame, read_frame
from mwdn.io.reading import open_regular
from mwdn.types import Frame

MOST_ROWS = 2**21
"""Most pairs of one file: listing them takes 0.7 GB."""

SMALLEST_PICTURE = 67
"""Bytes of the smallest PNG: a file cannot hold more pictures than this allows."""

UNPACKED_BYTES, PACKED_PART = 2**28, 20
"""Pictures are compressed already: rows that unpack to over 256 MiB and 20 times the file are refused."""

COPY_AGAIN = "Copy it from its source again."

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


@dataclass(frozen=True)
class Source:
    """One pair that has not been read yet.

    Args:
        name: a file's stem, or a row.
        load: reads the capture and the scene as stored, (H, W, C), or raises `ImageError`.
    """

    name: str
    load: Callable[[], tuple[Frame, Frame]]


@dataclass(frozen=True)
class Listing:
    """The pairs of a data set, in its order, and the reason for each file or row that cannot be used, by its name."""

    sources: list[Source]
    refused: dict[str, str] = field(default_factory=dict)


def list_folders(path: Path, captures: str, scenes: str) -> Listing:
    """Pair the pictures of two folders and their subfolders by stem, in natural order (im2 before im10).

    Args:
        path: of the data set.
        captures: folder of the measurements in ``path``.
        scenes: folder of the ground truth in ``path``.

    Raises:
        ImageError: a folder is missing, or two files differ only in their suffix.
    """
    files = {folder: _by_stem(path / folder) for folder in (captures, scenes)}
    stems = sorted(set(files[captures]) | set(files[scenes]), key=_natural)
    refused, sources = {}, []
    for stem in stems:
        missing = [folder for folder in (captures, scenes) if stem not in files[folder]]
        if missing:
            present = next(paths[stem] for paths in files.values() if stem in paths)
            refused[stem] = f"`{present}` has no partner in `{path / missing[0]}`. Add it, or remove this one."
        else:
            sources.append(Source(stem, partial(_read_both, files[captures][stem], files[scenes][stem])))
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
        if data is None or data.ndim != 4 or data.shape[1] not in (1, 3) or data.dtype != "u1":
            raise ImageError(
                f"`{path}` must have `{name}`, (N, 3, H, W) of uint8, but has {names_in(path, file)}. "
                "Name the data sets: `--captures blur --scenes gt`."
            )
    counts = [len(file[name]) for name in (captures, scenes)]
    complete = min(counts)
    if max(counts) > MOST_ROWS:
        raise ImageError(f"`{path}` claims {max(counts):,} pairs; at most {MOST_ROWS:,} are imported. Divide it.")
    refused = {
        f"row {row}": f"Row {row} of `{path}` is in one of `{captures}` ({counts[0]:,}) and `{scenes}` ({counts[1]:,})"
        f" only. {COPY_AGAIN}"
        for row in range(complete, max(counts))
    }
    return Listing(
        [Source(f"row {row}", partial(_read_row, path, file, (captures, scenes), row)) for row in range(complete)],
        refused,
    )


def list_parquet(path: Path, captures: str, scenes: str) -> Listing:
    """List the rows of parquet shards, as on the Hugging Face hub, whose columns hold encoded pictures.

    Args:
        path: a shard, a folder of shards, or a name on the hub such as ``owner/name``.
        captures: column of the measurements.
        scenes: column of the ground truth.

    Raises:
        ImageError: nothing there, or ``pyarrow`` (for the hub ``huggingface_hub``) is not installed.
    """
    folder = path if path.exists() else _download(path)
    shards = sorted(folder.rglob("*.parquet"), key=lambda shard: _natural(str(shard))) if folder.is_dir() else [folder]
    if not shards:
        raise ImageError(f"`{path}` has no file that ends in .parquet. Name a shard, or the folder of the shards.")
    sources: list[Source] = []
    refused = {}
    for shard in shards:
        try:
            rows = _Shard(shard, (captures, scenes))
        except ImageError as error:
            refused[shard.name] = str(error)
            continue
        sources += [Source(f"{shard.name} row {row}", partial(rows.load, row)) for row in range(rows.count)]
    return Listing(sources, refused)


class _Shard:
    """A parquet file. It is read in order, a few rows at a time."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        try:
            from pyarrow import parquet
        except ModuleNotFoundError as error:
            raise _missing("pyarrow", "parquet") from error
        self.path, self.columns = path, list(columns)
        open_regular(path).close()
        with as_damage(f"`{path}` is not a complete parquet file", COPY_AGAIN):
            self._file: Any = parquet.ParquetFile(path, buffer_size=2**20)
            names = self._file.schema_arrow.names
            groups = [self._file.metadata.row_group(i) for i in range(self._file.metadata.num_row_groups)]
            rows = [group.num_rows for group in groups]
            self.count, self._ends = sum(rows), np.cumsum(rows, dtype=np.int64)
            # Not by columns: pyarrow ends the process with an abort for the statistics of a damaged one.
            largest = max((group.total_byte_size for group in groups), default=0)
        if not set(self.columns) <= set(names):
            advice = "Name two of them: `--captures lensless --scenes lensed`."
            raise ImageError(f"`{path}` must have the columns {self.columns}, but has {str(names)[:80]}. {advice}")
        size = path.stat().st_size
        if min(rows, default=0) < 0 or self.count * SMALLEST_PICTURE > size:
            raise ImageError(f"`{path}` claims {self.count:,} rows, but has {size:,} bytes for them. {COPY_AGAIN}")
        if largest > max(PACKED_PART * size, UNPACKED_BYTES):
            raise ImageError(f"`{path}` would take {largest:,} bytes unpacked, but has {size:,}. {COPY_AGAIN}")
        self._group, self._next, self._rows = -1, 0, self._read(-1)

    def load(self, row: int) -> tuple[Frame, Frame]:
        """Capture and scene of a row, (H, W, C).

        Raises:
            ImageError: the row or its picture is damaged.
        """
        group = int(np.searchsorted(self._ends, row, side="right"))
        cells: list[Any] | None = []
        with as_damage(f"Row {row} of `{self.path}` cannot be read", COPY_AGAIN):
            if group != self._group or row < self._next:
                start = int(self._ends[group - 1]) if group else 0
                self._group, self._next, self._rows = group, start, self._read(group)
            while self._next <= row and cells is not None:
                cells, self._next = next(self._rows, None), self._next + 1
        if cells is None:
            raise ImageError(f"Row {row} of `{self.path}` cannot be read: one before it is damaged. {COPY_AGAIN}")
        capture, scene = (self._decode(cell, column, row) for cell, column in zip(cells, self.columns, strict=True))
        return capture, scene

    def _read(self, group: int) -> Iterator[list[Any]]:
        # One value may be shared by all rows: in a thousand rows at once it would take a thousand times its memory.
        for batch in self._file.iter_batches(4, row_groups=[group], columns=self.columns, use_threads=False):
            for row in range(batch.num_rows):
                yield [batch.column(name)[row].as_py() for name in self.columns]

    def _decode(self, cell: object, column: str, row: int) -> Frame:
        data = cell.get("bytes") if isinstance(cell, dict) else cell
        name = f"`{column}` of row {row} of `{self.path}`"
        if not isinstance(data, bytes):
            raise ImageError(f"{name} must hold the bytes of a picture, but holds {type(data).__name__}. {COPY_AGAIN}")
        return decode_frame(data, name)


def _download(name: Path) -> Path:
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name.as_posix()) or name.suffix == ".parquet":
        raise ImageError(f"`{name}` does not exist. Name a shard, a folder of shards, or `owner/name` on the hub.")
    try:
        from huggingface_hub import snapshot_download
    except ModuleNotFoundError as error:
        raise _missing("huggingface_hub", "hub", f"`{name}` is not on this machine. To download it, ") from error
    try:
        return Path(snapshot_download(name.as_posix(), repo_type="dataset", allow_patterns="*.parquet"))
    except Exception as error:  # the errors of its network library, which changes between versions
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ImageError(
            f"`{name}` cannot be downloaded from the hub: {reason}. Download it and name its folder."
        ) from error


def _missing(package: str, extra: str, purpose: str = "") -> ImageError:
    return ImageError(f"{purpose}`{package}` must be installed: `pip install 'mwdn[{extra}]'`.")


def _by_stem(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        raise ImageError(
            f"`{folder}` is not a folder. Name the folders inside the data set: `--captures A --scenes B`."
        )
    paths: dict[str, Path] = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() not in READABLE or file.name.startswith(".") or not file.is_file():
            continue
        stem = file.relative_to(folder).with_suffix("").as_posix()
        if stem in paths:
            raise ImageError(f"`{paths[stem]}` and `{file}` differ only in their suffix. Remove one of them.")
        paths[stem] = file
    return paths


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that places im2 before im10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _read_both(capture: Path, scene: Path) -> tuple[Frame, Frame]:
    return read_frame(capture), read_frame(scene)


def _read_row(path: Path, file: Any, names: tuple[str, str], row: int) -> tuple[Frame, Frame]:  # noqa: ANN401
    with as_damage(f"Row {row} of `{path}` cannot be read", COPY_AGAIN):
        capture, scene = (np.moveaxis(file[name][row], 0, -1) for name in names)
        return capture, scene
