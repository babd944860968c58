"""Parquet shards, as on the Hugging Face hub, whose columns hold encoded pictures."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.data.hdf5 import as_damage
from mwdn.errors import ImageError, reason
from mwdn.io.headers import COPY_AGAIN
from mwdn.io.images import decode_frame
from mwdn.io.reading import open_regular
from mwdn.runtime.requirement import require
from mwdn.types import Frame

MIN_PICTURE = 67
"""Bytes of the smallest PNG: a file cannot hold more pictures than this allows."""

UNPACKED_BYTES, PACKED_PART = 2**28, 20
"""Pictures are compressed already: rows that unpack to over 256 MiB and 20 times the file are refused."""


def find_shards(path: Path, patterns: tuple[str, ...] = ("*.parquet",)) -> list[Path]:
    """Parquet files of a path or of a name on the hub, in natural order.

    Args:
        path: a shard, a folder of shards, or a name on the hub such as ``owner/name``.
        patterns: files to download from the hub.

    Raises:
        MissingPackageError: the package of the hub is not installed.
        ImageError: nothing there, or the hub cannot be reached.
    """
    folder = path if path.exists() else _download(path, patterns)
    shards = (
        sorted(folder.rglob("*.parquet"), key=lambda shard: natural_order(str(shard))) if folder.is_dir() else [folder]
    )
    if not shards:
        raise ImageError(f"`{path}` has no file that ends in .parquet. Name a shard, or the folder of the shards.")
    return shards


def natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key that places im2 before im10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


class Shard:
    """A parquet file. It is read in order, a few rows at a time.

    Args:
        path: of the file.
        columns: those with encoded pictures.

    Raises:
        MissingPackageError: pyarrow is not installed.
        ImageError: it is damaged, lacks a column, or claims more than it can hold.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        parquet = require("pyarrow.parquet", "parquet", purpose=f"`{path}`")
        self.path, self.columns = path, list(columns)
        open_regular(path).close()
        with as_damage(f"`{path}` is not a complete parquet file", COPY_AGAIN):
            self._file: Any = parquet.ParquetFile(path, buffer_size=2**20)
            names = self._file.schema_arrow.names
            self.names = tuple(map(str, names))
            groups = [self._file.metadata.row_group(i) for i in range(self._file.metadata.num_row_groups)]
            rows = [group.num_rows for group in groups]
            self.count, self._ends = sum(rows), np.cumsum(rows, dtype=np.int64)
            # Not by columns: pyarrow aborts the process on the statistics of a damaged column.
            largest = max((group.total_byte_size for group in groups), default=0)
        if not set(self.columns) <= set(names):
            advice = "Name two of them: `--captures lensless --scenes lensed`."
            raise ImageError(f"`{path}` must have the columns {self.columns}, but has {str(names)[:80]}. {advice}")
        size = path.stat().st_size
        if min(rows, default=0) < 0 or self.count * MIN_PICTURE > size:
            raise ImageError(f"`{path}` claims {self.count:,} rows, but has {size:,} bytes for them. {COPY_AGAIN}")
        if largest > max(PACKED_PART * size, UNPACKED_BYTES):
            raise ImageError(f"`{path}` would take {largest:,} bytes unpacked, but has {size:,}. {COPY_AGAIN}")
        self._group, self._next, self._rows = -1, 0, self._read(-1)

    def numbers(self, column: str) -> list[Any]:
        """The values of a column without pictures, such as labels.

        Raises:
            ImageError: the column is damaged.
        """
        with as_damage(f"`{column}` of `{self.path}` cannot be read", COPY_AGAIN):
            batches = self._file.iter_batches(1024, columns=[column], use_threads=False)
            return [value for batch in batches for value in batch.column(column).to_pylist()]

    def load(self, row: int) -> tuple[Frame, ...]:
        """The pictures of a row, (H, W, C), in the order of the columns.

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
        return tuple(self._decode(cell, column, row) for cell, column in zip(cells, self.columns, strict=True))

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


def _download(name: Path, patterns: tuple[str, ...]) -> Path:
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name.as_posix()) or name.suffix == ".parquet":
        raise ImageError(f"`{name}` does not exist. Name a shard, a folder of shards, or `owner/name` on the hub.")
    hub = require("huggingface_hub", "hub", purpose=f"`{name}` is not on this machine. Its download")
    try:
        return Path(
            hub.snapshot_download(
                name.as_posix(),
                repo_type="dataset",
                allow_patterns=list(patterns) if len(patterns) > 1 else patterns[0],
            )
        )
    except Exception as error:  # the errors of its network library, which changes between versions
        raise ImageError(
            f"`{name}` cannot be downloaded from the hub: {reason(error)}. Download it and name its folder."
        ) from error
