"""Messages that C libraries print while they decode a picture: libjpeg reports damaged pixels in no other way."""

import ctypes
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class _Messages:
    """A stream in memory that takes the place of C's ``stderr``.

    File descriptor 2 and Python's ``sys.stderr`` stay as they are: other threads and child processes print as before.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.stderr: Any = None  # the variable of C
        try:
            glibc = "CS_GNU_LIBC_VERSION" in getattr(os, "confstr_names", ())  # musl's variable cannot be written to
            if glibc or sys.platform == "darwin":
                self.c = ctypes.CDLL(None)
                self.c.open_memstream.restype = ctypes.c_void_p
                self.text, self.size = ctypes.c_void_p(), ctypes.c_size_t()
                stream = self.c.open_memstream(ctypes.byref(self.text), ctypes.byref(self.size))
                self.stream = ctypes.c_void_p(stream)
                name = "__stderrp" if sys.platform == "darwin" else "stderr"
                self.stderr = ctypes.c_void_p.in_dll(self.c, name) if stream else None
                self.real = self.stderr.value if stream else None
        except (OSError, ValueError, AttributeError):  # another C library: messages reach the terminal
            self.stderr = None

    def begin(self) -> None:
        if self.stderr is not None:
            self.c.rewind(self.stream)
            self.stderr.value = self.stream.value

    def end(self) -> list[str]:
        if self.stderr is None:
            return []
        self.stderr.value = self.real
        self.c.fflush(self.stream)
        text = ctypes.string_at(self.text.value, self.size.value) if self.text.value and self.size.value else b""
        return text.decode(errors="replace").splitlines()


_messages: _Messages | None = None
_first = threading.Lock()


def _forget() -> None:
    """In a forked child: restore ``stderr`` and unlock, because the thread that decoded does not exist there."""
    global _messages, _first
    if _messages is not None and _messages.stderr is not None:
        _messages.stderr.value = _messages.real
    _messages, _first = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


@contextmanager
def decoder_messages() -> Iterator[list[str]]:
    """Collect the lines that C libraries print meanwhile; they do not reach the terminal.

    Decoders in several threads take turns. Works with glibc and on macOS; elsewhere the list stays empty.

    Yields:
        A list that is filled when the context ends.
    """
    global _messages
    with _first:
        _messages = _messages or _Messages()
    lines: list[str] = []
    messages = _messages
    with messages.lock:
        messages.begin()
        try:
            yield lines
        finally:
            lines += messages.end()
