"""HDF5 files that grow for days: after a crash or a power failure, the last committed state is on the disk.

HDF5 changes a file in several places for each new row. A process that is killed between two of these changes leaves a
file that cannot be opened. Here HDF5 writes to a `JournalledFile`. New bytes go to the end of the file at once, where
nothing refers to them yet. Changes of earlier bytes are held back until `Growing.commit`, which

1. flushes the file: the new bytes are on the disk;
2. writes all changes to a journal beside the file, with a checksum, and flushes it;
3. applies them to the file.

A process that is killed before step 2 is complete leaves the state before; after it, the next `open_growing` finds the
journal and repeats step 3, which is idempotent.

References:
    J. Gray and A. Reuter, Transaction Processing (1993), chapter 10: write-ahead logging.
"""

import hashlib
import os
import struct
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from mwdn.data.hdf5 import CheckedFile, as_damage, as_incomplete, open_hdf5_header, read_attributes
from mwdn.errors import ImageError
from mwdn.io.files import check_regular
from mwdn.io.reading import open_regular, read_bytes

IDENTITY = "session"
"""Attribute with a random text: links the journal to its file, and distinguishes a file that has grown from another
one."""

_HEAD = 2**16  # bytes at the start of a file, where HDF5 keeps the first attribute of the root group
_MAX_BYTES = 2**30  # bytes of a journal: far more than HDF5's tables of a million rows
_MAGIC = b"mwdnjrn1"
_START = struct.Struct("<8s32sQI")  # magic, identity, length of the file, number of changes
_CHANGE = struct.Struct("<QI")  # place in the file, number of bytes
_DIGEST = 16

Changes = list[tuple[int, bytes]]


class JournalledFile(CheckedFile):
    """The file that HDF5 writes to: bytes before `committed` change only in `apply`."""

    def __init__(self, path: Path, mode: str) -> None:
        super().__init__(path, mode)
        self.committed = self.seek(0, os.SEEK_END)
        self.changes: Changes = []
        self.seek(0)

    def write(self, data: Any, /) -> int:  # noqa: ANN401
        """Append the bytes beyond `committed`, and hold those before it back."""
        given = memoryview(data).cast("B")
        place = self.tell()
        held = given[: max(self.committed - place, 0)]
        if held:
            self.changes.append((place, bytes(held)))
            self.seek(place + len(held))
        return len(held) + super().write(given[len(held) :])

    def readinto(self, buffer: Any, /) -> int:  # noqa: ANN401
        """Read bytes as they will be after the commit."""
        start = self.tell()
        count = super().readinto(buffer)
        into = memoryview(buffer).cast("B")
        for place, data in self.changes:
            first, last = max(place, start), min(place + len(data), start + count)
            if first < last:
                into[first - start : last - start] = data[first - place : last - place]
        return count

    def truncate(self, size: int | None = None, /) -> int:
        """Cut or extend the part beyond `committed`."""
        wanted = self.tell() if size is None else size
        return super().truncate(wanted) if wanted >= self.committed else wanted

    def apply(self) -> None:
        """Write the changes that were held back; the appended bytes are then committed, too.

        Raises:
            OSError: the disk has refused these bytes, or earlier ones.
        """
        for place, data in self.changes:
            self.seek(place)
            super().write(data)
        self.check()
        self.changes = []
        self.committed = self.seek(0, os.SEEK_END)


class Growing:
    """An HDF5 file open for adding to it, from `create_growing` or `open_growing`.

    Args:
        path: of the file.
        disk: the file on the disk.
        file: the open `h5py.File`.
    """

    def __init__(self, path: Path, disk: JournalledFile, file: Any) -> None:  # noqa: ANN401
        self.path, self.disk, self.file = path, disk, file
        self._identity = str(file.attrs[IDENTITY])

    def commit(self) -> None:
        """Make everything that was written to `file` permanent, all or nothing.

        Raises:
            OSError: the disk is full, or another error of it. The state before is on the disk; `file` is of no use.
        """
        self.file.flush()
        self.disk.check()
        try:
            os.fsync(self.disk.fileno())
            _write_journal(journal_of(self.path), self._identity, self.disk)
            self.disk.apply()
        except BaseException as error:
            self.disk.error = error
            raise


def journal_of(path: Path) -> Path:
    """The journal of a growing file; it exists while the file is open, and after a process was killed."""
    return path.with_name(f".{path.name}.journal")


@contextmanager
def create_growing(path: Path) -> Iterator[Growing]:
    """Create a file, which must not exist. It exists after the first `Growing.commit`.

    Raises:
        ImageError: it exists, or another process is writing it.
        OSError: the folder cannot be written to, or the disk is full.
    """
    import h5py

    check_regular(path)
    with _alone(path):
        if path.exists():
            raise ImageError(f"`{path}` exists. Go on with it, or choose another name: `out`.")
        journal_of(path).unlink(missing_ok=True)
        new = path.with_name(f".{path.name}.new")
        new.unlink(missing_ok=True)
        with JournalledFile(new, "x+") as disk:
            file = h5py.File(disk, "w")
            file.attrs[IDENTITY] = uuid.uuid4().hex
            with _finished(Growing(path, disk, file)) as growing:
                growing.commit()
                new.rename(path)
                _flush_folder(path.parent)
                yield growing


@contextmanager
def open_growing(path: Path) -> Iterator[Growing]:
    """Open a file to add to it, in its last committed state.

    Raises:
        ImageError: no such file, damaged, not made by `create_growing`, or another process is writing it.
        OSError: the disk.
    """
    import h5py

    advice = "Start a new one: another name for `out`."
    check_regular(path)
    open_regular(path).close()
    with _alone(path):
        recover(path)
        with open_hdf5_header(path, advice) as file:
            if IDENTITY not in read_attributes(path, file, advice):
                raise ImageError(f"`{path}` was not made by this command: it cannot grow. {advice}")
        with JournalledFile(path, "r+") as disk:
            with as_incomplete(path, advice):
                file = h5py.File(disk, "r+")
            with _finished(Growing(path, disk, file)) as growing:
                yield growing


def recover(path: Path) -> None:
    """Bring a file to its last committed state after a process was killed.

    Raises:
        ImageError: the journal beside it belongs to another file.
        OSError: the disk.
    """
    journal = journal_of(path)
    content = _read_journal(journal)
    if content is not None:
        identity, length, changes = content
        with path.open("rb+") as file:
            if identity not in file.read(_HEAD):
                raise ImageError(f"`{journal}` belongs to another file than `{path}`. Move it away.")
            if file.seek(0, os.SEEK_END) < length:
                raise ImageError(f"`{path}` is shorter than it was: restore it.")
            file.truncate(length)
            for place, data in changes:
                file.seek(place)
                file.write(data)
            file.flush()
            os.fsync(file.fileno())
    journal.unlink(missing_ok=True)


@contextmanager
def _finished(growing: Growing) -> Iterator[Growing]:
    """At the end leave one file, in its last committed state, without a journal."""
    disk = growing.disk
    try:
        yield growing
    finally:
        committed = disk.committed
        disk.committed = sys.maxsize  # HDF5's uncommitted changes are not written
        growing.file.close()
        os.ftruncate(disk.fileno(), committed)
        os.fsync(disk.fileno())
        journal_of(growing.path).unlink(missing_ok=True)


def _write_journal(journal: Path, identity: str, disk: JournalledFile) -> None:
    length = disk.seek(0, os.SEEK_END)
    content = _START.pack(_MAGIC, identity.encode(), length, len(disk.changes))
    content += b"".join(_CHANGE.pack(place, len(data)) + data for place, data in disk.changes)
    is_new = not journal.exists()
    with journal.open("wb") as file:
        file.write(content + hashlib.blake2b(content, digest_size=_DIGEST).digest())
        file.flush()
        os.fsync(file.fileno())
    if is_new:
        _flush_folder(journal.parent)


def _read_journal(journal: Path) -> tuple[bytes, int, Changes] | None:
    """Identity, length of the file and changes; ``None`` without a complete journal."""
    if not journal.exists():
        return None
    content = read_bytes(journal, most=_MAX_BYTES)
    body, digest = content[:-_DIGEST], content[-_DIGEST:]
    if hashlib.blake2b(body, digest_size=_DIGEST).digest() != digest or body[:8] != _MAGIC:
        return None
    with as_damage(f"`{journal}` is damaged", "Move it away."):
        _, identity, length, count = _START.unpack_from(body)
        place, changes = _START.size, []
        for _ in range(count):
            at, size = _CHANGE.unpack_from(body, place)
            place += _CHANGE.size
            if at + size > length or place + size > len(body):
                raise ValueError("a change lies outside of the file")
            changes.append((at, body[place : place + size]))
            place += size
    return identity, length, changes


def _flush_folder(folder: Path) -> None:
    """Flush a folder, so that a new name in it is on the disk."""
    with suppress(OSError):  # Windows cannot
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    lock = FileLock(path.with_name(f".{path.name}.lock"))
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise ImageError(f"Another process is writing `{path}`. Wait for it, or choose another name: `out`.") from None
    try:
        yield
    finally:
        lock.release()
