"""Files of (measurement, scene) pairs: HDF5 with one raw chunk per sample, for random access by several workers."""

import operator
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple, SupportsIndex

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from mwdn.data.hdf5 import as_damage, as_incomplete, find_rows, names_in, open_hdf5, open_hdf5_header, read_attributes
from mwdn.data.journal import IDENTITY
from mwdn.data.pair_writer import FORMAT_VERSION, PAIR_PARTS, VERSION_KEY, Attribute, PairWriter, PixelType, Shape
from mwdn.errors import ImageError, ParameterError, shown
from mwdn.types import Psf

_MAKE_AGAIN = (
    "Make it again: remove it, and repeat the `mwdn import`, `align`, `simulate` or `benchmark` that wrote it."
)


@dataclass(frozen=True)
class Part:
    """Some pairs of a file, by their positions."""

    file: "PairFile"
    rows: range | list[int]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        return self.file[self.rows[index]]


class _Header(NamedTuple):
    """Everything in a file except the pixels. It is read once and passed to the workers."""

    length: int
    measurement_shape: Shape
    scene_shape: Shape
    attributes: dict[str, Attribute]


class PairFile(Dataset[tuple[Tensor, Tensor]]):
    """A file of pairs, as a data set for `torch.utils.data.DataLoader`.

    Each process opens the file on its first read, so workers can be forked or spawned. Threads may share it.

    Args:
        path: HDF5 with the data sets ``measurement`` and ``scene``, both (N, H, W, C) of uint8, uint16 or float32,
            and optionally ``psf``, (C, H, W) of float32.

    Raises:
        ImageError: no such file; damaged, cut off, or not a file of pairs.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        # The open file and its data sets, by process. A lookup by name takes as long as reading a pair.
        self._opened: dict[int, tuple[Any, dict[str, Any]]] = {}
        with open_hdf5_header(self.path, _MAKE_AGAIN) as file:
            self._header = _read_header(self.path, file)

    @classmethod
    def create(
        cls,
        path: str | Path,
        *,
        measurement_shape: Shape,
        scene_shape: Shape,
        dtype: PixelType = "float32",
        attributes: Mapping[str, Attribute] | None = None,
        psf: Tensor | None = None,
    ) -> PairWriter:
        """Create a file; use it in a ``with`` statement, at the end of which the file gets its name.

        Args:
            path: of the file, ending in .h5 or .hdf5. An existing file is replaced only after success.
            measurement_shape: (H, W, C) of each measurement, C of 1 or 3.
            scene_shape: (H, W, C) of each scene, which may be larger than the sensor.
            dtype: of both. float32 keeps negative noise; integers clip it.
            attributes: metadata of the camera.
            psf: (C, H, W) or (1, C, H, W), stored as float32.

        Raises:
            ParameterError: wrong suffix, shape, type or attribute.
            ImageError: the path is a folder.
            ShapeError: the PSF has wrong axes.
        """
        return PairWriter(Path(path), (measurement_shape, scene_shape), dtype, dict(attributes or {}), psf)

    def __len__(self) -> int:
        return self._header.length

    def __getitem__(self, index: SupportsIndex) -> tuple[Tensor, Tensor]:
        """Measurement and scene, each (C, H, W), linear light, float32, nominally in [0, 1].

        A file of `mwdn capture` has raw frames and displayed pictures, with the sensor's full scale and white as 1.

        Raises:
            IndexError: there is no such pair.
            ParameterError: the index is no whole number, for example a slice.
            ImageError: the pair cannot be read.
        """
        try:
            number = operator.index(index)
        except TypeError as error:
            raise ParameterError(
                f"`index` ({shown(index)}) must be one whole number. For several pairs: "
                "`torch.utils.data.Subset(pairs, range(0, 2))`."
            ) from error
        if not -len(self) <= number < len(self):
            raise IndexError(f"`{self.path}` has {len(self):,} pairs; there is no pair {number}.")
        number %= len(self)
        measurement, scene = (self._read(name, number) for name in PAIR_PARTS)
        return measurement, scene

    @property
    def attributes(self) -> dict[str, Attribute]:
        """Metadata of the camera."""
        return dict(self._header.attributes)

    @property
    def raw_bits(self) -> int | None:
        """Bit depth of the raw frames of a file of `mwdn capture` before `mwdn align`; ``None`` for other files."""
        bits = self._header.attributes.get("bit_depth") if IDENTITY in self._header.attributes else None
        return bits if isinstance(bits, int) and 0 < bits <= 16 else None

    @property
    def measurement_shape(self) -> Shape:
        """Height, width and channels of a measurement."""
        return self._header.measurement_shape

    @property
    def scene_shape(self) -> Shape:
        """Height, width and channels of a scene."""
        return self._header.scene_shape

    @property
    def psf(self) -> Psf | None:
        """(1, C, H, W), as stored, or ``None`` if the file has none."""
        file, _ = self._open()
        data = find_rows(self.path, file, "psf", _MAKE_AGAIN)
        if data is None:
            return None
        if data.ndim != 3 or data.dtype.kind != "f":
            raise ImageError(f"`psf` of `{self.path}` ({data.shape}, {data.dtype}) must be floats, (C, H, W).")
        with as_damage(f"`psf` of `{self.path}` cannot be read", _MAKE_AGAIN):
            return torch.from_numpy(data[()].astype(np.float32))[None]

    def close(self) -> None:
        """Close the file in this process; the next read opens it again."""
        while self._opened:
            self._opened.popitem()[1][0].close()

    def __enter__(self) -> "PairFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}

    def _open(self) -> tuple[Any, dict[str, Any]]:
        """The file and its data sets."""
        process = os.getpid()
        if process in self._opened:
            return self._opened[process]
        for parent in {*self._opened} - {process}:
            # After a fork the handle is the parent's. Closing this copy does not close the parent's.
            if opened := self._opened.pop(parent, None):
                opened[0].close()
        file = open_hdf5(self.path, _MAKE_AGAIN)
        if not self._is_same(file):
            raise ImageError(f"`{self.path}` was replaced by another file meanwhile. Start again.")
        mine = file, {name: file[name] for name in PAIR_PARTS}
        first = self._opened.setdefault(process, mine)
        if first is not mine:  # another thread was faster
            file.close()
        return first

    def _is_same(self, file: Any) -> bool:  # noqa: ANN401
        """Whether the open file is that of the header, or has grown since (`mwdn.data.journal`)."""
        shapes, session = _read_shapes(self.path, file), self._header.attributes.get(IDENTITY)
        has_grown = session is not None and file.attrs.get(IDENTITY) == session and shapes[0] > len(self)
        return shapes[1:] == self._header[1:3] and (has_grown or shapes[0] == len(self))

    def _read(self, name: str, number: int) -> Tensor:
        with as_damage(f"`{name}` {number} of `{self.path}` cannot be read", _MAKE_AGAIN):
            stored = self._open()[1][name][number]
        pixels = stored.transpose(2, 0, 1).astype(np.float32, order="C")
        if stored.dtype.kind == "u":
            bits = self.raw_bits if name == PAIR_PARTS[0] else None  # 12 bits are in the lower bits of 16
            pixels /= np.float32(2**bits - 1 if bits else np.iinfo(stored.dtype).max)
        return torch.from_numpy(pixels)


def _read_header(path: Path, file: Any) -> _Header:  # noqa: ANN401
    shapes = _read_shapes(path, file)
    attributes = read_attributes(path, file, _MAKE_AGAIN)
    version = attributes.pop(VERSION_KEY, FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise ImageError(f"`{path}` has format version {version}, but version {FORMAT_VERSION} is needed. Update mwdn.")
    return _Header(*shapes, attributes)


def _read_shapes(path: Path, file: Any) -> tuple[int, Shape, Shape]:  # noqa: ANN401
    with as_incomplete(path, _MAKE_AGAIN):
        if "gt" in file and "blur" in file:
            raise ImageError(f"`{path}` is the authors' file: `mwdn import mwdn {quote(str(path))} -o pairs.h5`.")
    shapes = []
    for name in PAIR_PARTS:
        data = find_rows(path, file, name, _MAKE_AGAIN)
        if data is None:
            raise ImageError(
                f"`{path}` must have the data set `{name}`, but has {names_in(path, file)}. `mwdn import` makes "
                "a file of pairs."
            )
        dtypes = ("|u1", "<u2", ">u2", "<f4", ">f4")
        if data.ndim != 4 or data.shape[-1] not in (1, 3) or data.dtype.str not in dtypes:
            raise ImageError(
                f"`{name}` of `{path}` ({data.shape}, {data.dtype}) must be (N, H, W, C) of uint8, uint16 or float32, "
                "with 1 or 3 channels last."
            )
        shapes.append(data.shape)
    if shapes[0][0] != shapes[1][0]:
        raise ImageError(f"`{path}` has {shapes[0][0]:,} measurements and {shapes[1][0]:,} scenes. {_MAKE_AGAIN}")
    return shapes[0][0], shapes[0][1:], shapes[1][1:]


def refuse_non_finite(pair: tuple[Tensor, Tensor], number: int) -> None:
    """Raise a `ParameterError` if measurement or scene of the pair of this number hold NaN or infinity."""
    for name, picture in zip(PAIR_PARTS, pair, strict=True):
        if not picture.isfinite().all():
            raise ParameterError(
                f"The {name} of pair {number}, counted from 0, holds NaN or infinity. Make the file anew without it."
            )
