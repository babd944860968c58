"""Atomic writing of files, and errors of the disk as errors of this package."""

import errno
import hashlib
import json
import os
import re
import secrets
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from mwdn.errors import ImageError, ParameterError

FULL = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT}
"""Errors of a disk that is full, of a file that would be larger than allowed, and of a user's share that is used up."""


_MARKED_BYTES = 2**20
"""Part of a file in which its mark is searched: a foreign file may be larger than the memory."""


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Write a file completely or not at all.

    The file is written under a hidden name in the same folder, and renamed once it is on the disk. If anything fails
    before that, an existing ``path`` keeps its content and the hidden file is removed. That of a process that
    was killed is removed by the next process that writes to the folder.

    Args:
        path: the file to write. Missing folders are created.

    Yields:
        The temporary name to write to: same folder and suffix as ``path``, unique to this call.

    Raises:
        OSError: the folder cannot be written to, the disk is full, or ``path`` is something else than a regular file:
            a folder, a device, or a symbolic link, whose target is not replaced.
    """
    path = path.absolute()
    check_regular(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(path.parent)
    # Without the stem of `path`: a long one plus the token could exceed the 255 bytes of a file name.
    temporary = path.with_name(f".mwdn-{_computer()}-{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        with _as_os_error():
            yield temporary
        temporary.chmod(mode)  # the folder's usual mode: safetensors makes its files readable by their owner only
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _as_os_error() -> Iterator[None]:
    """Turn the error that safetensors raises when the disk is full into the `OSError` that it stands for."""
    try:
        yield
    except SafetensorError as error:
        code = re.search(r"\(os error (\d+)\)", str(error))
        raise (OSError(int(code[1]), os.strerror(int(code[1]))) if code else OSError(str(error))) from error


@cache
def _computer() -> str:
    """Identifies the computer since its start, and the container: process numbers are unique within it.

    Empty if the system does not provide it; leftover files are then unknown, and stay.
    """
    try:
        start = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        return hashlib.sha256(f"{start} {Path('/proc/self/ns/pid').readlink()}".encode()).hexdigest()[:8]
    except OSError:
        return ""


@cache
def _remove_leftovers(folder: Path) -> None:
    """Remove the hidden files of processes that were killed, once for each folder.

    Only files of this computer are removed, because another computer that shares the folder may still be writing.
    """
    hidden = re.compile(rf"\.mwdn-{_computer()}-(\d+)-[0-9a-f]{{8}}(\..*)?")
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries if _computer() else []:
            match = hidden.fullmatch(entry.name)
            if match and entry.is_file(follow_symlinks=False) and not _is_running(int(match[1])):
                Path(entry.path).unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)  # sends nothing
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # it belongs to another user
        return True
    return True


def check_regular(path: Path) -> None:
    """Check that a file to be written is new or a regular file.

    Raises:
        OSError: it is a folder, a device, a pipe or a symbolic link.
    """
    if path.is_symlink():
        raise OSError(errno.ELOOP, f"it is a symbolic link to `{path.readlink()}`, which is not followed", str(path))
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))


def is_full(error: BaseException | None) -> bool:
    """Whether an error says that the disk is full."""
    # numpy's own errors have no number, only "1000 requested and 10 written".
    return isinstance(error, OSError) and (error.errno is None or error.errno in FULL)


@contextmanager
def as_image_error(path: str | Path, at: str = "") -> Iterator[None]:
    """Turn an `OSError` while writing a file into an `ImageError` that names the file, and ``at`` which item it was."""
    try:
        yield
    except OSError as error:
        advice = "Make room, or choose another folder." if is_full(error) else "Choose another folder."
        advice = "Choose a shorter name." if error.errno == errno.ENAMETOOLONG else advice
        why = error.strerror or f"The disk may be full ({error})"
        raise ImageError(f"`{path}` cannot be written{at}: {why}. {advice}") from error


@contextmanager
def as_parameter_error(folder: Path, advice: str = "Choose another one: `out`.") -> Iterator[None]:
    """Turn an error of the disk while writing into a folder into a `ParameterError` that names the folder."""
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        raise ParameterError(f"`{folder}` must be a folder that can be written to: {why}. {advice}") from error


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """`atomic`, with errors of the disk as `ImageError`."""
    with as_image_error(path), atomic(Path(path)) as temporary:
        yield temporary


def write_text(path: Path, text: str) -> None:
    """Write a text file, atomically.

    Raises:
        ImageError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file, atomically.

    Raises:
        ImageError: the file cannot be written.
    """
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def check_folder(folder: Path) -> None:
    """Check that a folder can be written to, or created, before any work starts. Nothing is left behind.

    Raises:
        ParameterError: it cannot be created or written to.
    """
    with as_parameter_error(folder), tempfile.TemporaryFile(dir=existing_folder(folder)):
        pass


def existing_folder(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def refuse_overwrite(output: Path, *inputs: Path | None) -> None:
    """Check that an output file can be written and is not one of the inputs.

    Raises:
        ParameterError: it is one of them, or something else than a regular file.
    """
    try:
        check_regular(output)
    except OSError as error:
        raise ParameterError(f"`{output}` cannot be written: {error.strerror}. Choose another name: `out`.") from None
    for path in filter(None, inputs):
        if output.exists() and path.exists() and output.samefile(path):
            raise ParameterError(f"`{output}` would overwrite an input. Choose another name: `out`.")


def refuse_foreign(folder: Path, files: Sequence[str], mark: bytes) -> None:
    """Check that existing files of a folder, which will be replaced, are results of this package.

    Args:
        folder: the output folder.
        files: names of the files that will be replaced. The first identifies their owner, and is written first.
        mark: bytes in the first MiB of the first file if this package wrote it.

    Raises:
        ParameterError: one of the files exists and is not of this package, or is not a regular file.
    """
    for name in files:
        refuse_overwrite(folder / name)
    first = folder / files[0]
    if first.is_file():
        with first.open("rb") as file:
            if mark in file.read(_MARKED_BYTES):
                return
    foreign = next((folder / name for name in files if (folder / name).exists()), None)
    if foreign is not None:
        raise ParameterError(
            f"`{foreign}` was not written by this command and would be lost. Choose another folder: `out`."
        )


def cache_folder() -> Path:
    """Folder where downloads are kept: ``~/.cache/mwdn``."""
    return Path.home() / ".cache" / "mwdn"


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def path_resolver() -> Callable[[str], str]:
    """A function like `Path.resolve` that scans each folder once: a million files take seconds, not minutes."""
    folders: dict[str, tuple[str, dict[str, str]]] = {}

    def scan(folder: Path) -> tuple[str, dict[str, str]]:
        links: dict[str, str] = {}
        if folder.is_dir():
            with os.scandir(folder) as entries:
                links = {entry.name: os.path.realpath(entry.path) for entry in entries if entry.is_symlink()}
        return str(folder.resolve() / "x").removesuffix("x"), links

    def resolve(path: str) -> str:
        folder, name = os.path.split(path)
        if folder not in folders:
            folders[folder] = scan(Path(folder))
        start, links = folders[folder]
        return links.get(name) or start + name

    return resolve
