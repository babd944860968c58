"""HDF5 files: written so that a full disk is noticed at the pair that no longer fits."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class CheckedFile(io.FileIO):
    """The file that HDF5 writes to; an error of the disk is kept for `check`, and HDF5 never sees it.

    After a write that failed, HDF5 either calls the file complete, with zeros for the data that were lost, or cannot
    close it and ends the process with a segmentation fault. So it is told that every write succeeded, and nothing is
    written after the first error.
    """

    error: BaseException | None = None

    def write(self, data: Any, /) -> int:  # noqa: ANN401
        """Write all bytes, unless an earlier write failed."""
        rest = memoryview(data)
        size = rest.nbytes
        try:
            while rest.nbytes and self.error is None:
                rest = rest[super().write(rest) :]  # a disk that is almost full takes a part
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
