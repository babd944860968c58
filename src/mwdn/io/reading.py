"""Read untrusted files: regular files only, no more bytes than expected, never mapped."""

import errno
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from mwdn.errors import ImageError, MwdnError, ParameterError, reason

TEXT_BYTES = 2**20
"""Most bytes of a TOML file: 1 MiB; the longest recipe of the package has 4 kB."""

JSON_BYTES = 2**26
"""Most bytes of a JSON file: 64 MiB, far more than any record of this package."""


LOG_BYTES = 2**28
"""Most bytes of a log of training: 256 MiB, about 2 million steps."""


def open_regular(path: str | Path, error: type[MwdnError] = ImageError) -> BinaryIO:
    """Open a regular file for reading.

    Opening a pipe would wait for a writer forever, and a device has no end: both are refused, also behind a link.

    Args:
        path: of the file.
        error: raised if it cannot be opened.

    Raises:
        MwdnError: of the kind ``error``: no such file, a link to itself, a folder, pipe, socket or device, or no
            permission.
    """
    try:
        _check_regular(Path(path).stat().st_mode)  # before opening, because that may affect a device
        flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
        file = open(path, "rb", opener=lambda name, _: os.open(name, flags))  # noqa: SIM115
        try:
            _check_regular(os.fstat(file.fileno()).st_mode)  # another file may have taken its place
        except BaseException:
            file.close()
            raise
    except ImageError as wrong:
        raise error(f"`{path}` {wrong}") from None
    except (OSError, ValueError) as wrong:  # ValueError: a zero byte in the name
        raise error(f"`{path}` {_why(wrong)}") from wrong
    return file


def _check_regular(mode: int) -> None:
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a pipe" if stat.S_ISFIFO(mode) else "a device or socket"
        raise ImageError(f"must be a file, but is {what}. Name one file inside a folder; save a pipe as a file.")


def _why(error: OSError | ValueError) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.ENOENT, errno.ENOTDIR):
        return f"does not exist. Check the name; the current folder is `{Path.cwd()}`."
    if code == errno.ELOOP:
        return "is a link that leads back to itself. Link it to the file."
    return f"cannot be read: {getattr(error, 'strerror', None) or reason(error)}. Check its permissions."


def read_bytes(path: str | Path, *, most: int, error: type[MwdnError] = ImageError) -> bytes:
    """Read a whole regular file into memory; a file that shrinks meanwhile gives fewer bytes.

    Args:
        path: of the file.
        most: bytes of the file; more are refused before any is read.
        error: as in `open_regular`.

    Raises:
        MwdnError: of the kind ``error``: it cannot be opened or read, or has more bytes.
    """
    with open_regular(path, error) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise error(f"`{path}` has {size:,} bytes; at most {most:,} are read. Check that it is the right file.")
        try:
            return file.read(size)
        except OSError as wrong:
            raise error(f"`{path}` {_why(wrong)}") from wrong


def read_text(path: str | Path, *, most: int = TEXT_BYTES, error: type[MwdnError] = ParameterError) -> str:
    """Read a whole file of UTF-8, as `read_bytes`.

    Raises:
        MwdnError: as for `read_bytes`, or the file is not UTF-8.
    """
    content = read_bytes(path, most=most, error=error)
    try:
        return content.decode("utf-8-sig")  # editors on Windows write a byte order mark
    except UnicodeDecodeError as wrong:
        raise error(f"`{path}` must be text in UTF-8, but byte {wrong.start:,} is not. Save it as UTF-8.") from wrong


def read_json(path: str | Path) -> Any:  # noqa: ANN401
    """Read a JSON file.

    Raises:
        ParameterError: as for `read_text`, or the content is not JSON.
    """
    return parse_json(read_text(path, most=JSON_BYTES), path)


def parse_json(text: str | bytes, path: str | Path, *, error: type[MwdnError] = ParameterError) -> Any:  # noqa: ANN401
    """Parse JSON of a file.

    Args:
        text: the JSON.
        path: of the file, for the message.
        error: raised if it is none.

    Raises:
        MwdnError: of the kind ``error``.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as wrong:  # ValueError also: a number of over 4,300 digits
        raise error(f"`{path}` is not JSON: {reason(wrong)}. It may be damaged: remove it, or restore it.") from wrong


@contextmanager
def unexpected_content(path: str | Path) -> Iterator[None]:
    """Turn errors about the content of a file of this package (`KeyError`, `TypeError` ...) into one line.

    Raises:
        ParameterError: the file is damaged, or of another version.
    """
    try:
        yield
    except MwdnError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as wrong:
        what = f"{type(wrong).__name__}: {reason(wrong)}"
        raise ParameterError(f"`{path}` is damaged, or of another version ({what}). Remove it.") from wrong
