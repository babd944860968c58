"""Writing files of pairs, which `mwdn.data.pairs` reads."""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from mwdn.errors import ImageError, ParameterError, ShapeError
from mwdn.io.files import as_image_error, atomic
from mwdn.types import Frame

Attribute = str | int | float
"""What is worth knowing about the camera: ``psf_hash``, ``pitch_um``, anything else."""

PixelType = Literal["uint8", "uint16", "float32"]
"""How a file stores its numbers. Integers are [0, 1] times their largest one."""

Shape = tuple[int, int, int]
"""Height, width and channels of one sample, in the order in which the file stores them."""

VERSION = 1
"""Of the format, stored as the attribute `VERSION_KEY`."""

VERSION_KEY = "mwdn_pairs"
NAMES = ("measurement", "scene")
SUFFIXES = ".h5", ".hdf5"

# A number outside this is no noise around [0, 1] but another scale, 0 to 255 for instance.
_LOWEST, _HIGHEST = -0.5, 1.5


def check_path(path: Path) -> None:
    """See that a file of pairs may have this name: never that of a picture, which it would replace.

    Raises:
        ImageError: it is a folder.
        ParameterError: it has another suffix.
    """
    if path.is_dir():
        raise ImageError(f"`{path}` is a folder. Name a file in it: `{path / 'pairs.h5'}`.")
    real = path.resolve()  # what a link points to is what would be replaced
    if real.suffix.lower() not in SUFFIXES:
        name = real.with_suffix(".h5").name
        raise ParameterError(f"`{real.name}` must end in .h5 or .hdf5, as files of pairs do: `{name}`.")


class PairWriter:
    """A file of pairs while it is being written; `PairFile.create` makes one.

    It has a hidden name in the folder of ``path`` until the ``with`` statement ends without an exception.
    """

    def __init__(
        self,
        path: Path,
        shapes: tuple[Shape, Shape],
        dtype: PixelType,
        attributes: dict[str, Attribute],
        psf: Tensor | None,
    ) -> None:
        check_path(path)
        for name, shape in zip(NAMES, shapes, strict=True):
            if len(shape) != 3 or min(shape) < 1:
                raise ParameterError(f"`{name}_shape` {tuple(shape)} must be (height, width, channels), all positive.")
        if dtype not in ("uint8", "uint16", "float32"):
            raise ParameterError(f"`dtype` ('{dtype}') must be 'uint8', 'uint16' or 'float32'.")
        for key, value in attributes.items():
            if not isinstance(value, str | int | float) or key == VERSION_KEY:
                raise ParameterError(f"`attributes` must hold text and numbers; '{key}' is {type(value).__name__}.")
        self.path, self.dtype = path, np.dtype(dtype)
        self._shapes, self._attributes, self._psf = dict(zip(NAMES, shapes, strict=True)), attributes, _stored(psf)
        self._stack = ExitStack()
        self._file: Any = None
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def __enter__(self) -> "PairWriter":
        import h5py

        with as_image_error(self.path), ExitStack() as stack:
            self._file = stack.enter_context(h5py.File(stack.enter_context(atomic(self.path)), "w"))
            self._file.attrs.update({VERSION_KEY: VERSION, **self._attributes})
            for name, shape in self._shapes.items():
                self._file.create_dataset(
                    name, (0, *shape), self.dtype, maxshape=(None, *shape), chunks=(1, *shape), track_times=False
                )
            if self._psf is not None:
                self._file.create_dataset("psf", data=self._psf, track_times=False)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # An exception of the ``with`` statement's own body passes through unchanged: the stack only cleans up.
        with as_image_error(self.path):
            self._stack.__exit__(kind, error, trace)
        self._file = None

    def append(self, measurement: Tensor | Frame, scene: Tensor | Frame) -> None:
        """Add a pair, or a batch of pairs.

        Args:
            measurement: a tensor (B, C, H, W) or (C, H, W), or an array (B, H, W, C) or (H, W, C). Floats are
                nominally in [0, 1]; integers are parts of their type's largest number.
            scene: likewise, as many.

        Raises:
            ShapeError: another size than the file's, or not as many scenes as measurements.
            ParameterError: NaN, or numbers of another scale than [0, 1].
            ImageError: the disk refuses, or the ``with`` statement has not begun or is over.
        """
        if self._file is None:
            raise ImageError(f"`{self.path}` is not open. Append inside `with PairFile.create(...) as file:`.")
        rows = [self._rows(name, pixels) for name, pixels in zip(NAMES, (measurement, scene), strict=True)]
        if len(rows[0]) != len(rows[1]):
            raise ShapeError(
                f"`measurement` ({len(rows[0])}) and `scene` ({len(rows[1])}) must be as many. Append whole pairs."
            )
        end = self._length + len(rows[0])
        with as_image_error(self.path):
            for name, batch in zip(NAMES, rows, strict=True):
                self._file[name].resize(end, axis=0)
                self._file[name][self._length : end] = batch
        self._length = end

    def _rows(self, name: str, pixels: Tensor | Frame) -> Frame:
        """(B, H, W, C), in the numbers of the file."""
        if isinstance(pixels, Tensor):
            array = pixels.detach().cpu().movedim(-3, -1).numpy() if pixels.ndim >= 3 else pixels.numpy()
        else:
            array = pixels
        batch = array[None] if array.ndim == 3 else array
        if batch.ndim != 4 or batch.shape[1:] != self._shapes[name]:
            got, wanted = (" x ".join(map(str, shape)) for shape in (array.shape, self._shapes[name]))
            raise ShapeError(
                f"`{name}` ({got} in the order of the file: height, width, channels) must be {wanted}, as the first "
                f"of `{self.path}`. Crop or resize it."
            )
        return quantise(batch, self.dtype, name)


def quantise(pixels: Frame, dtype: np.dtype[Any], name: str = "pixels") -> Frame:
    """Turn numbers of one type into those of another, 1 being the largest integer of each.

    Args:
        pixels: uint8, uint16, or floats nominally in [0, 1].
        dtype: uint8 and uint16 clip to [0, 1] and round; float32 keeps what lies a little outside.
        name: of the pixels, for the message.

    Raises:
        ParameterError: NaN, infinity, another type, or numbers of another scale.
    """
    if pixels.dtype == dtype and dtype.kind == "u":
        return pixels
    if pixels.dtype.kind == "u" and pixels.dtype.itemsize <= 2:
        pixels = pixels / np.float32(np.iinfo(pixels.dtype).max)
    elif pixels.dtype.kind != "f":
        raise ParameterError(f"`{name}` ({pixels.dtype}) must be floats, uint8 or uint16. Convert it with `astype`.")
    low, high = (float(pixels.min()), float(pixels.max())) if pixels.size else (0.0, 0.0)
    if not (low >= _LOWEST and high <= _HIGHEST):  # NaN fails this too
        raise ParameterError(f"`{name}` ({low:.4g} to {high:.4g}) must be in [0, 1]. Divide it by its full scale.")
    if dtype.kind == "f":
        return pixels.astype(dtype)
    return np.rint(pixels.clip(0, 1) * np.float64(np.iinfo(dtype).max)).astype(dtype)


def _stored(psf: Tensor | None) -> Frame | None:
    if psf is None:
        return None
    picture = psf[0] if psf.ndim == 4 and len(psf) == 1 else psf
    if picture.ndim != 3:
        raise ShapeError(f"`psf` {tuple(psf.shape)} must be (C, H, W) or (1, C, H, W).")
    return picture.detach().to("cpu", torch.float32).numpy()
