"""HDF5 files: a full disk is reported at the pair that no longer fits; nothing outside the file is ever read."""

import io
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.errors import ImageError, MwdnError, reason
from mwdn.io.reading import open_regular

PICTURE_BYTES = 2**29
"""Limit of the bytes of one picture, and of one chunk, which is decompressed as a whole: 512 MiB, 44 million RGB
floats."""

Numbers = str | int | float
"""Value of an attribute."""


class CheckedFile(io.FileIO):
    """The file that HDF5 writes to; errors of the disk are hidden from HDF5 and kept for `check`.

    After a write that failed, HDF5 either calls the file complete, with zeros for the data that were lost, or cannot
    close it and ends the process with a segmentation fault. So every write reports success to HDF5, and nothing is
    written after the first error.
    """

    error: BaseException | None = None

    def write(self, data: Any, /) -> int:  # noqa: ANN401
        """Write all bytes, unless an earlier write failed."""
        rest = memoryview(data)
        size = rest.nbytes
        try:
            while rest.nbytes and self.error is None:
                rest = rest[super().write(rest) :]  # a disk that is almost full writes only a part
        except BaseException as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Cut or extend the file, unless an earlier write failed."""
        try:
            return super().truncate(size) if self.error is None else 0
        except BaseException as error:
            self.error = error
            return 0

    def check(self) -> None:
        """Raise the first error."""
        if self.error is not None:
            raise self.error


@contextmanager
def create_hdf5(path: Path) -> Iterator[tuple[Any, CheckedFile]]:
    """Create a file.

    Yields:
        The open `h5py.File`, and the file on the disk: call its `CheckedFile.check` after each step.

    Raises:
        OSError: the disk is full, or another error of it.
    """
    import h5py

    with CheckedFile(path, "w+") as disk:
        with h5py.File(disk, "w") as file:
            yield file, disk
        disk.check()


def add_rows(file: Any, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:  # noqa: ANN401
    """A data set that grows, one chunk for each array and 1,024 numbers for scalars; an existing one is returned."""
    if name in file:
        return file[name]
    chunk = (1, *shape) if shape else (1024,)
    native = dtype.newbyteorder("=")
    return file.create_dataset(name, (0, *shape), native, maxshape=(None, *shape), chunks=chunk, track_times=False)


def write_row(data: Any, value: Any) -> None:  # noqa: ANN401
    """Append one row."""
    number = len(data)
    data.resize(number + 1, axis=0)
    if data.ndim > 1:  # past HDF5's cache of chunks: on the disk at once, in a third of the time
        data.id.write_direct_chunk((number, *[0] * (data.ndim - 1)), np.ascontiguousarray(value, data.dtype))
    else:
        data[number] = value


@contextmanager
def as_damage(what: str, advice: str) -> Iterator[None]:
    """Turn any error of a library that reads a damaged file into an `ImageError`: ``{what}: {reason}. {advice}``."""
    try:
        yield
    except MwdnError:
        raise
    except Exception as error:  # h5py and pyarrow raise a dozen kinds of errors for damaged files
        raise ImageError(f"{what}: {reason(error)}. {advice}") from error


def as_incomplete(path: Path, advice: str) -> AbstractContextManager[None]:
    """`as_damage` for the structure of a whole file."""
    return as_damage(f"`{path}` is not a complete HDF5 file", advice)


def open_hdf5(path: Path, advice: str) -> Any:  # noqa: ANN401
    """Open a file for reading.

    Args:
        path: of the file.
        advice: the way out for a damaged file.

    Raises:
        ImageError: no such file, not a regular one, or not a complete HDF5 file.
    """
    import h5py

    open_regular(path).close()
    with as_incomplete(path, advice):
        # No lock: finished files never change, and many shared file systems of clusters do not support locks. A file
        # that this process has open with a lock, as in a notebook, can only be opened in the same way.
        for locking in (False, None):
            try:
                return h5py.File(path, "r", locking=locking)
            except OSError as error:
                if "flag values don't match" not in str(error):
                    raise
        return h5py.File(path, "r", locking=True)


class _CheckedHeaps(io.FileIO):
    """The file that HDF5 reads a header from; refuses a damaged heap of texts, in which HDF5 would search forever."""

    def readinto(self, buffer: Any, /) -> int:  # noqa: ANN401
        count = super().readinto(buffer)
        if bytes(buffer[:4]) == b"GCOL":
            self._check(bytes(buffer))
        return count

    @staticmethod
    def _check(heap: bytes) -> None:
        """HDF5's format specification, section III.E: 16 bytes in front of the heap and of each object in it."""
        size, start = int.from_bytes(heap[8:16], "little"), 16
        while start + 16 <= min(size, len(heap)):
            index, length = (int.from_bytes(heap[start + a : start + b], "little") for a, b in ((0, 2), (8, 16)))
            step = 16 + -(-length // 8) * 8 if index else length  # 0 is the free space, with its own 16 bytes
            if not 16 <= step <= size - start:
                raise OSError("damaged heap")
            start += step


@contextmanager
def open_hdf5_header(path: Path, advice: str) -> Iterator[Any]:
    """Open a file for its attributes and for what it says about its data sets; slow for the numbers in them.

    Raises:
        ImageError: as for `open_hdf5`.
    """
    import h5py

    open_regular(path).close()
    with ExitStack() as stack:
        with as_incomplete(path, advice):
            file = stack.enter_context(h5py.File(stack.enter_context(_CheckedHeaps(path)), "r"))
            if file.id.get_create_plist().get_sizes() != (8, 8):
                raise ImageError(f"`{path}` has addresses or lengths of other than 8 bytes. {advice}")
        yield file


def find_rows(path: Path, file: Any, name: str, advice: str) -> Any:  # noqa: ANN401
    """A data set, (N, ...), whose numbers are all in the file.

    Links elsewhere, virtual data sets and external storage can name any file of the computer: they are refused, not
    followed.

    Args:
        path: of the file.
        file: the open `h5py.File`.
        name: of the data set; may be in a group: ``train/blur``.
        advice: the way out for a damaged file.

    Returns:
        The `h5py.Dataset`; ``None`` if there is none of this name.

    Raises:
        ImageError: it is damaged or elsewhere, does not hold all of its numbers, or pictures are too large.
    """
    import h5py

    with as_damage(f"`{name}` of `{path}` cannot be read", advice):
        place = file
        for part in filter(None, name.split("/")):
            link = place.get(part, getlink=True) if isinstance(place, h5py.Group) else None
            if link is None:
                return None
            if not isinstance(link, h5py.HardLink):
                raise ImageError(f"`{name}` of `{path}` is a link, which is not followed. Copy the data to its place.")
            place = place[part]
        if not isinstance(place, h5py.Dataset):
            return None
        _check_storage(path, place, name)
        return place


def _check_storage(path: Path, data: Any, name: str) -> None:  # noqa: ANN401
    from h5py import h5d

    settings = data.id.get_create_plist()
    if settings.get_layout() == h5d.VIRTUAL or settings.get_external_count():
        raise ImageError(f"`{name}` of `{path}` is stored in other files, which are not read. Copy the data into one.")
    _check_filters(path, data, name, [settings.get_filter(i)[0] for i in range(settings.get_nfilters())])
    size = data.dtype.itemsize * math.prod(data.shape)
    stored, available = data.id.get_storage_size(), path.stat().st_size
    if data.chunks is None:
        whole = stored == size
    else:
        needed = math.prod(math.ceil(a / b) for a, b in zip(data.shape, data.chunks, strict=True))
        whole = needed <= available and data.id.get_num_chunks() == needed
    if not whole or stored > available or (size == 0 and len(data)):
        raise ImageError(
            f"`{name}` of `{path}` must hold {size:,} bytes {data.shape}, but not all of them are in the file. "
            "It was not finished, or it is damaged."
        )
    picture = data.dtype.itemsize * math.prod(data.shape[1:])
    most = max(picture, data.dtype.itemsize * math.prod(data.chunks or ()))
    if most > PICTURE_BYTES:
        raise ImageError(
            f"`{name}` of `{path}` has pictures or chunks of {most:,} bytes; at most {PICTURE_BYTES:,} are read. "
            "Crop or bin the pictures, or store them in smaller chunks."
        )


def _check_filters(path: Path, data: Any, name: str, filters: list[int]) -> None:  # noqa: ANN401
    from h5py import h5z

    others = set(filters) - {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_LZF}
    if others or h5z.FILTER_FLETCHER32 in filters[:-1]:
        raise ImageError(
            f"`{name}` of `{path}` is packed by the filters {str(filters)[:40]}; gzip, lzf, shuffle and, as the last, "
            "fletcher32 are read. Pack it again: `h5repack -f GZIP=4`."
        )
    small: list[Any] = []
    if h5z.FILTER_FLETCHER32 in filters:  # HDF5 crashes on a chunk that is shorter than its checksum
        data.id.chunk_iter(lambda chunk: small.append(chunk) if chunk.size < 4 else None)
    if small:
        raise ImageError(f"`{name}` of `{path}` has a chunk of less than 4 bytes. It is damaged.")


def read_attributes(path: Path, file: Any, advice: str) -> dict[str, Numbers]:  # noqa: ANN401
    """Text and numbers among the attributes of a file from `open_hdf5_header`; others are left out.

    Raises:
        ImageError: they are damaged.
    """
    import h5py

    attributes = {}
    with as_damage(f"The attributes of `{path}` cannot be read", advice):
        for name in file.attrs:
            if not isinstance(name, str):  # bytes: not UTF-8
                continue
            stored = file.attrs.get_id(name)
            # HDF5 crashes on a sequence of numbers whose length is damaged; damage can turn the type of a text into
            # this one.
            if stored.shape == () and (stored.dtype.kind in "biufSU" or h5py.check_string_dtype(stored.dtype)):
                value = file.attrs[name]
                value = value.item() if hasattr(value, "item") else value
                if isinstance(value, Numbers):
                    attributes[name] = value
    return attributes


def names_in(path: Path, file: Any) -> str:  # noqa: ANN401
    """The first names in a file, for a message."""
    with as_incomplete(path, "It is damaged."):
        return str(sorted(islice(file, 4)))[:80]
