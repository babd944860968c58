"""Read untrusted files of `torch.save`, without running code from them."""

import pickletools
import re
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import torch

from mwdn.errors import CheckpointError, MwdnError, ParameterError
from mwdn.io.reading import open_regular

FILE_BYTES = 2**29
"""Most bytes of a file: 512 MiB, twice those of the paper's largest network with the moments of its optimiser."""

PICKLE_BYTES = 2**20
"""Most bytes of the part that names the tensors: 1 MiB; that of such a file has 0.1 MiB."""

_DIRECTORY_BYTES = 2**20
_LEGACY_PICKLES = 5  # magic number, version, machine, content, names of the storages; before torch 1.6
_GLOBALS = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor|tensor_v2|parameter)|torch\.storage UntypedStorage"
    r"|torch (\w+Storage|Size|device|b?float\d*|u?int\d+|double|half|long|bool)"
)
"""Names in the pickle of plain weights. torch allows more, for example ``bytearray``, which could allocate 4 GB."""


def read_plain(path: Path) -> Any:  # noqa: ANN401
    """Read a file of `torch.save`, on the CPU, without running code from it.

    Raises:
        CheckpointError: the file is too large, damaged, packed, or holds more than plain values.
    """
    with open_regular(path, CheckpointError) as file:
        try:
            _check(file)
            file.seek(0)
            return torch.load(file, map_location="cpu", weights_only=True)
        except MemoryError as error:
            raise _refused(path, "it asks for more memory than there is") from error
        except ParameterError as error:
            raise _refused(path, str(error)) from None
        except Exception as error:  # torch, zipfile and pickletools raise many kinds for damaged files
            # Without torch's message, which is ten lines long and suggests unpickling the file nevertheless.
            raise _refused(path, "it is damaged, or of another format") from error


def _refused(path: Path, why: str) -> MwdnError:
    return CheckpointError(
        f"`{path}` cannot be read as plain weights: {why}. Copy it again, or save its `state_dict()` alone."
    )


def _check(file: BinaryIO) -> None:
    """Check the size of a file's parts, and what they are made of.

    Raises:
        ParameterError: why the file is refused.
        Exception: of the libraries, for a damaged file.
    """
    size = file.seek(0, 2)
    if size > FILE_BYTES:
        raise ParameterError(f"it has {size:,} bytes, of which at most {FILE_BYTES:,} are read")
    file.seek(0)
    if file.read(4) != b"PK\3\4":
        file.seek(0)
        start = BytesIO(file.read(PICKLE_BYTES))
        for _ in range(_LEGACY_PICKLES):
            _check_pickle(start)
        return
    if _directory_bytes(file, size) > _DIRECTORY_BYTES:
        raise ParameterError("it has too many parts")
    with zipfile.ZipFile(file) as archive:
        parts = archive.infolist()
        if any(part.compress_type != zipfile.ZIP_STORED for part in parts) or sum(p.file_size for p in parts) > size:
            raise ParameterError("its parts are compressed or overlap")
        for part in parts:
            if part.filename.endswith(".pkl"):
                if part.file_size > PICKLE_BYTES:
                    raise ParameterError("it holds too many values")
                _check_pickle(BytesIO(archive.read(part)))


def _directory_bytes(file: BinaryIO, size: int) -> int:
    """Bytes of a ZIP file's directory, as its end record says, or that of ZIP64 before it; 0 without one."""
    file.seek(max(0, size - 2**16 - 98))
    tail = file.read()
    end = tail.rfind(b"PK\5\6")
    if end < 0:
        return 0
    large = end - 20 - 56  # the ZIP64 record and its locator come right before
    if large >= 0 and tail[large:].startswith(b"PK\6\6"):
        return int.from_bytes(tail[large + 40 : large + 48], "little")
    return int.from_bytes(tail[end + 12 : end + 16], "little")


def _check_pickle(stream: BytesIO) -> None:
    """Check all names of code in a pickle, without unpickling it."""
    for operation, argument, _ in pickletools.genops(stream):
        if operation.name == "STACK_GLOBAL" or (
            operation.name in ("GLOBAL", "INST") and not _GLOBALS.fullmatch(str(argument))
        ):
            raise ParameterError("it holds objects, whose code is not run")
