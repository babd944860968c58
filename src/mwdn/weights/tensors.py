"""Read untrusted safetensors files. The header is checked before any tensor is read; nothing is mapped into memory.

The format: 8 bytes with the length of the header (little-endian), the header (JSON), and the tensors' bytes. A file
that shrinks while it is mapped would end the process by a signal; read in the usual way, it is only too short.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import torch
from torch import Tensor, nn

from mwdn.errors import CheckpointError, MwdnError
from mwdn.io.reading import open_regular, parse_json

HEADER_BYTES = 2**22
"""Most bytes of a header: 4 MiB. That of the largest network has 50 kB, with its recipe."""

MAX_AXES = 8
_DTYPES = {"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}
_DTYPES |= {"I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8}


class Entry(NamedTuple):
    """Where a tensor is in a file.

    Args:
        dtype: of the tensor.
        shape: of the tensor.
        start: position of its first byte in the file.
        size: number of its bytes.
    """

    dtype: torch.dtype
    shape: tuple[int, ...]
    start: int
    size: int


@dataclass(frozen=True)
class Header:
    """Header of a safetensors file.

    Args:
        metadata: text by name.
        entries: the tensors by name.
    """

    metadata: dict[str, Any]
    entries: dict[str, Entry]


def is_safetensors(path: Path) -> bool:
    """Whether a file begins like safetensors: with the length of a table in JSON, and the table.

    Raises:
        CheckpointError: no regular file.
    """
    with open_regular(path, CheckpointError) as file:
        start = file.read(9)
    return start[8:] == b"{" and int.from_bytes(start[:8], "little") <= HEADER_BYTES


def read_header(path: Path) -> Header:
    """Read and check the header of a file.

    Raises:
        CheckpointError: no regular file, or no safetensors.
    """
    with open_regular(path, CheckpointError) as file:
        size = file.seek(0, 2)
        file.seek(0)
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= min(HEADER_BYTES, size - 8):
            raise _damaged(path, f"its header has {length:,} of {size:,} bytes")
        text = file.read(length)
    content = parse_json(text, path, error=CheckpointError)
    if not isinstance(content, dict):
        raise _damaged(path, "its header is no table")
    metadata = content.pop("__metadata__", {})
    return Header(
        metadata if isinstance(metadata, dict) else {},
        {key: _entry(path, key, value, first=8 + length, size=size) for key, value in content.items()},
    )


def _entry(path: Path, key: str, value: Any, *, first: int, size: int) -> Entry:  # noqa: ANN401
    value = value if isinstance(value, dict) else {}
    dtype, shape, offsets = (value.get(name) for name in ("dtype", "shape", "data_offsets"))
    known = isinstance(dtype, str) and dtype in _DTYPES
    if known and _whole(shape, size) and _whole(offsets, size) and len(offsets) == 2 and len(shape) <= MAX_AXES:
        start, end = offsets
        if first + end <= size and math.prod(shape) * _DTYPES[dtype].itemsize == end - start:
            return Entry(_DTYPES[dtype], tuple(shape), first + start, end - start)
    raise _damaged(path, f"the entry `{key[:80]}` of its header does not fit the file")


def _whole(numbers: Any, most: int) -> bool:  # noqa: ANN401
    """Whether it is a list of whole numbers from 0 to ``most``."""
    return isinstance(numbers, list) and all(type(n) is int and 0 <= n <= most for n in numbers)


def read_tensors(path: Path, header: Header) -> Iterator[tuple[str, Tensor]]:
    """Read the tensors of a file one by one.

    Raises:
        CheckpointError: the file cannot be read, or has become shorter than its header says.
    """
    with open_regular(path, CheckpointError) as file:
        for key, entry in header.entries.items():
            yield key, _read(file, path, entry)


def _read(file: BinaryIO, path: Path, entry: Entry) -> Tensor:
    data = torch.empty(entry.size, dtype=torch.uint8)
    file.seek(entry.start)
    if file.readinto(data.numpy()) != entry.size:  # type: ignore[attr-defined]
        raise _damaged(path, "it ends before its last tensor")
    return data.view(entry.dtype).reshape(entry.shape)


def _damaged(path: Path, why: str) -> MwdnError:
    return CheckpointError(f"`{path}` cannot be read as safetensors: {why}. Copy it from its source again.")


def check_shapes(network: nn.Module, shapes: Mapping[str, tuple[int, ...]], what: str) -> None:
    """Check that tensors of these shapes fill a network of `mwdn.networks.empty.build_empty`.

    Args:
        network: without memory.
        shapes: by the names of its state.
        what: start of the message.

    Raises:
        CheckpointError: a tensor is missing, unexpected or of another shape.
    """
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    missing, unexpected = expected.keys() - shapes.keys(), shapes.keys() - expected.keys()
    if missing:
        raise CheckpointError(f"{what}: Missing key `{min(missing)}`, one of {len(missing):,}. Copy it again.")
    if unexpected:
        raise CheckpointError(f"{what}: Unexpected key `{min(unexpected)[:80]}`, one of {len(unexpected):,}.")
    for key, shape in expected.items():
        if shape != tuple(shapes[key]):
            stored = list(shapes[key])[:MAX_AXES]
            raise CheckpointError(f"{what}: size mismatch for {key}: {stored} instead of {list(shape)}. Copy it again.")


def fill(network: nn.Module, tensors: Iterable[tuple[str, Tensor]], what: str) -> nn.Module:
    """Give a network of `mwdn.networks.empty.build_empty` its weights, in its own data types; evaluation mode.

    Args:
        network: without memory.
        tensors: by the names of its state, of its shapes.
        what: start of the message.

    Raises:
        CheckpointError: NaN or infinity.
    """
    expected, state = network.state_dict(), {}
    for key, tensor in tensors:
        state[key] = tensor.to(expected[key].dtype)  # the bundled weights are float16
        if not state[key].isfinite().all():
            raise CheckpointError(f"{what} holds NaN or infinity, `{key}` first. Use an earlier checkpoint.")
    network.load_state_dict(state, assign=True)
    return network.eval()
