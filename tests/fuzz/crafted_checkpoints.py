"""Checkpoints that ask for too much, or for what no network has; each must be refused."""

import io
import json
import struct
import zipfile
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import torch
from safetensors.torch import save

from mwdn.networks import build

DEEP = "[" * 100_000
LONG = "9" * 5000


def header(content: dict[str, Any] | str, data: bytes = b"") -> bytes:
    """A safetensors file with this header."""
    text = (content if isinstance(content, str) else json.dumps(content)).encode()
    return struct.pack("<Q", len(text)) + text + data


@cache
def narrow() -> dict[str, torch.Tensor]:
    """State of an MWDN, which takes as long to build as most of these files take to be refused."""
    return build("mwdn", width=2).state_dict()


def small(name: str = "mwdn", text: str | None = None, **options: Any) -> bytes:
    """A checkpoint of a narrow network whose metadata says something else."""
    return save(narrow(), {"mwdn": text or json.dumps({"version": "0", "name": name, "options": options})})


OPTIONS: dict[str, dict[str, Any]] = {
    **{f"width {w}": {"width": w} for w in (20_000, 10**30, -1, 0, 2.5, "wide", [2], None, True, 10**7)},
    **{f"channels {c}": {"channels": c, "width": 2} for c in (-1, 0, 10**9, 10**25)},
    "iterations": {"name": "le-admm", "iterations": 10**7},
    "iterations of a U-Net": {"name": "le-admm-u", "iterations": 10**7, "width": 2},
    "iterations below 0": {"name": "le-admm", "iterations": -1},
    "depth": {"name": "updn", "depth": 10**7},
    "size": {"name": "updn", "size": [10**9, 10**9]},
    "size below 0": {"name": "flatnet", "size": [-3, 5]},
    "field": {"name": "svdeconv", "field": 10**6},
    "blocks": {"name": "drunet", "blocks": 10**7},
    "no widths": {"name": "drunet", "widths": []},
    "many widths": {"name": "drunet", "widths": [1] * 100_000},
    "fold": {"name": "wiener-bank", "fold": 10**6},
    "many lambdas": {"name": "wiener-bank", "regularisations": [1e-3] * 10**5},
    "nan": {"name": "wiener", "regularisation": float("nan")},
    "weight": {"name": "mwdn", "weight": -1.0},
    "name twice": {"name": "mwdn", "self": 1},
    "long name": {"name": "m" * 100_000},
    "long option": {"m" * 100_000: 1},
    "lines": {"name": "a\nb\x1b[31m"},
}
"""Options of a network, as the metadata holds them."""


def own() -> Iterator[tuple[str, bytes]]:
    """Files with the suffix ``.safetensors``, by what is wrong with them."""
    for what, options in OPTIONS.items():
        yield what, small(**{"name": "mwdn", **options})
    entry = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
    yield "nested header", header(DEEP)
    yield "nested metadata", small(text=DEEP)
    yield "digits in the header", header(f'{{"a": {LONG}}}')
    yield "digits in the metadata", small(text=f'{{"name": "mwdn", "options": {{"width": {LONG}}}}}')
    yield "digits in a shape", header(f'{{"a": {{"dtype": "F32", "shape": [{LONG[:4000]}], "data_offsets": [0, 4]}}}}')
    yield "long header", struct.pack("<Q", 2**62) + bytes(100)
    yield "header of 5 MB", header(" " * 5_000_000)
    for name, change in {
        "shape beyond the file": {"shape": [10**9]},
        "data beyond the file": {"data_offsets": [0, 10**9]},
        "negative shape": {"shape": [-1]},
        "fractional shape": {"shape": [1.0]},
        "no type": {"dtype": None},
        "sub-byte type": {"dtype": "F4"},
        "many axes": {"shape": [1] * 1000},
        "offsets the wrong way round": {"data_offsets": [4, 0]},
    }.items():
        yield name, header({"__metadata__": {"mwdn": '{"name": "mwdn", "options": {}}'}, "a": entry | change}, bytes(4))
    state = narrow()
    key = next(iter(state))
    options = {"mwdn": json.dumps({"name": "mwdn", "options": {"width": 2}})}
    yield "0-d tensor", save(state | {key: torch.tensor(1.0)}, options)
    yield "NaN", save(state | {key: state[key] * torch.nan}, options)
    yield (
        "beyond float32",
        save({k: v.double() for k, v in state.items()} | {key: state[key].double() + 1e300}, options),
    )


def authors(**changes: torch.Tensor) -> dict[str, torch.Tensor]:
    """State of the authors' MWDN with three feature channels, random numbers, and changes."""
    generator = torch.Generator().manual_seed(29)
    widths = (3, 3, 6, 12, 24, 24)
    state = {"w": torch.full((4,), 1e-3), "delta": torch.full((4,), 1e-2)}
    names = ("inc", *(f"down{i}.avgpool_conv.1" for i in (1, 2, 3, 4)))
    shapes = {name: (widths[i], widths[i + 1], widths[i + 1]) for i, name in enumerate(names)}
    shapes |= {f"up{i + 1}.conv": (a, a // 2, b) for i, (a, b) in enumerate(((48, 12), (24, 6), (12, 3), (6, 3)))}
    for name, (a, b, c) in shapes.items():
        for index, (before, after) in ((0, (a, b)), (3, (b, c))):
            start = f"{name}.double_conv.{index}"
            state[f"{start}.weight"] = torch.randn(after, before, 3, 3, generator=generator)
            norm = f"{name}.double_conv.{index + 1}"
            for key in (
                f"{start}.bias",
                f"{norm}.weight",
                f"{norm}.bias",
                f"{norm}.running_mean",
                f"{norm}.running_var",
            ):
                state[key] = torch.rand(after, generator=generator)
            state[f"{norm}.num_batches_tracked"] = torch.tensor(7)
    state |= {"outc.conv.weight": torch.rand(3, 3, 1, 1), "outc.conv.bias": torch.rand(3)}
    return state | changes


def stored(content: Any, *, legacy: bool = False) -> bytes:
    """Bytes of `torch.save`."""
    file = io.BytesIO()
    torch.save(content, file, _use_new_zipfile_serialization=not legacy)
    return file.getvalue()


def packed(pickle: bytes | None = None, *, compress: bool = False) -> bytes:
    """A file of `torch.save` with another pickle, or compressed."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(stored(authors()))) as source, zipfile.ZipFile(file, "w") as target:
        for part in source.infolist():
            data = pickle if pickle is not None and part.filename.endswith("data.pkl") else source.read(part)
            kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
            target.writestr(part.filename, data, compress_type=kind)
    return file.getvalue()


def foreign() -> Iterator[tuple[str, bytes]]:
    """Files of `torch.save`, by what is wrong with them."""
    first, ones = "inc.double_conv.0.weight", torch.ones(1)
    for what, changes in {
        "stride 0": {first: ones.expand(20_000, 3, 3, 3)},
        "stride 0, all": {key: ones.expand(value.shape or (1,)) for key, value in authors().items()},
        "0-d": {first: torch.tensor(1.0)},
        "0-d w": {"w": torch.tensor(1.0)},
        "NaN": {"outc.conv.bias": torch.full((3,), torch.nan)},
        "NaN delta": {"delta": torch.full((4,), torch.nan)},
        "complex": {"delta": torch.ones(4, dtype=torch.complex64)},
        "empty": {first: torch.ones(0, 3, 3, 3)},
        "sparse": {first: torch.eye(3).to_sparse()},
        "long name": {"x" * 100_000: ones},
    }.items():
        yield what, stored({"net_state_dict": authors(**changes)})
    yield "nested lists", packed(b"\x80\x02" + b"](" * 200_000 + b".")
    yield "bytearray of 4 GB", packed(b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\x00\x00\x00\x01\x85R.")
    yield "long integer", packed(b"\x80\x02I" + LONG.encode() + b"\n.")
    yield "many values", packed(b"\x80\x02]" + b"N0" * 2**20 + b".")
    yield "large memo", packed(b"\x80\x02]r\xff\xff\xff\x7f.")
    yield "compressed", packed(compress=True)
    yield "other code", packed(b"\x80\x02cos\nsystem\n.")
    end = struct.pack("<4H2IH", 0, 0, 9, 9, 2**30, 0, 0)
    yield "many parts", packed().replace(b"PK\5\6", b"PK\0\0") + b"PK\5\6" + end
    yield "old format", stored({"net_state_dict": authors(w=torch.tensor(1.0))}, legacy=True)
    yield "empty file", b""


def valid(random: np.random.Generator) -> tuple[str, bytes]:
    """A whole checkpoint, as a start for damage: its suffix and content."""
    kind = random.integers(0, 3)
    if kind == 0:
        return ".safetensors", small(width=2)
    return ".pt", whole(legacy=bool(kind == 2))


@cache
def whole(*, legacy: bool) -> bytes:
    """The authors' checkpoint, undamaged."""
    return stored({"net_state_dict": authors()}, legacy=legacy)
