"""Commands that fail early leave no empty folder behind."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import ParamSpec, TypeVar

FILE_SUFFIXES = frozenset({".h5", ".hdf5", ".onnx", ".pt2", ".zip"})
"""Suffixes of an ``out`` that is a file. A folder's name may have a dot: ``results/v1.2``."""

P = ParamSpec("P")
R = TypeVar("R")


def no_empty_folder(command: Callable[P, R]) -> Callable[P, R]:
    """Decorate a command: at its end, the folder of its ``out`` is removed if the command made it and wrote nothing."""

    @wraps(command)
    def run(*args: P.args, **named: P.kwargs) -> R:
        call = signature(command).bind(*args, **named)
        call.apply_defaults()
        out: Path = call.arguments["out"]
        with _removed_if_empty(out.parent if out.suffix.lower() in FILE_SUFFIXES else out):
            return command(*args, **named)

    return run


@contextmanager
def _removed_if_empty(folder: Path) -> Iterator[None]:
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        yield
    finally:
        for path in made if os.environ.get("RANK", "0") == "0" else ():  # one of several processes
            if path.is_dir() and not any(file.is_file() and file.suffix != ".lock" for file in path.rglob("*")):
                _remove(path)


def _remove(folder: Path) -> None:
    """Remove a folder of locks and folders; no other file, which another process may have written meanwhile."""
    with suppress(OSError):
        for path in sorted(folder.rglob("*"), reverse=True):
            if path.is_dir():
                path.rmdir()
            elif path.suffix == ".lock":
                path.unlink()
        folder.rmdir()
