"""Read NPY files: the header is checked before the numbers, which are read into memory and never mapped."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mwdn.errors import ImageError, reason
from mwdn.io.reading import open_regular

MAX_NPY_BYTES = 2**30
"""Most bytes of an array."""


def read_array(path: str | Path, check: Callable[[tuple[int, ...], Any], object] = lambda shape, dtype: None) -> Any:  # noqa: ANN401
    """Read an array of numbers.

    Args:
        path: of the file.
        check: called with shape and dtype before the numbers are read; raises `ImageError`, without the file's name,
            for an array that it does not accept.

    Raises:
        ImageError: not a complete NPY file of numbers, or over `MAX_NPY_BYTES`.
    """
    with open_regular(path) as file:
        try:
            return read_npy(file, check)
        except ImageError as error:
            raise ImageError(f"`{path}` {error}") from error


def read_npy(file: BinaryIO, check: Callable[[tuple[int, ...], Any], object]) -> Any:  # noqa: ANN401
    """Read an array from an open file; arguments and errors as for `read_array`, without the file's name."""
    shape, fortran, dtype = _read_header(file)
    if dtype.hasobject:
        raise ImageError("is not an NPY file of numbers: it holds Python objects, which may run code. Save numbers.")
    check(shape, dtype)
    size = math.prod(shape) * dtype.itemsize
    if size > MAX_NPY_BYTES:
        raise ImageError(f"claims {size:,} bytes of numbers; at most {MAX_NPY_BYTES:,} are read. Crop it.")
    left = os.fstat(file.fileno()).st_size - file.tell()
    data = file.read(size) if left >= size else b""
    if len(data) < size:
        raise ImageError(
            f"is not a complete NPY file: it needs {size:,} bytes of numbers and has {left:,}. Copy it again."
        )
    array = np.frombuffer(bytearray(data), dtype)
    return array.reshape(shape[::-1]).T if fortran else array.reshape(shape)


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, Any]:
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
        if not all(type(side) is int and side >= 0 for side in shape):
            raise ValueError(f"shape {shape}")
    except Exception as error:  # numpy evaluates the header as Python: SyntaxError, MemoryError, RecursionError ...
        raise ImageError(f"is not a complete NPY file of numbers ({reason(error)}). Copy or save it again.") from error
    return shape, fortran, dtype
