"""Write files of pairs, which `mwdn.data.pairs` reads."""

import math
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from mwdn.calibration.sensor_frames import MIN_RESPONSE
from mwdn.data.hdf5 import PICTURE_BYTES, CheckedFile, add_rows, create_hdf5, write_row
from mwdn.errors import ImageError, ParameterError, ShapeError, shown
from mwdn.io.files import as_image_error, atomic
from mwdn.types import Frame

Attribute = str | int | float
"""Metadata of the camera: ``psf_hash``, ``pitch_um`` or any other."""

PixelType = Literal["uint8", "uint16", "float32"]
"""Type of the numbers in a file. Integers are [0, 1] times the type's maximum."""

Shape = tuple[int, int, int]
"""Height, width and channels of one sample, in the file's order of axes."""

FORMAT_VERSION = 1
"""Version of the format, stored as the attribute `VERSION_KEY`."""

VERSION_KEY = "mwdn_pairs"
PAIR_PARTS = ("measurement", "scene")
PAIR_SUFFIXES = ".h5", ".hdf5"

# Numbers outside this range are not noise around [0, 1] but have another scale, for example 0 to 255.
_LOWEST, _HIGHEST = -0.5, 1.5


def check_path(path: Path) -> None:
    """Check that a file of pairs can have this name, so that it never replaces a picture.

    Raises:
        ImageError: the path is a folder.
        ParameterError: it does not end in .h5 or .hdf5.
    """
    if path.is_dir():
        raise ImageError(f"`{path}` is a folder. Name a file in it: `{path / 'pairs.h5'}`.")
    real = path.resolve()  # writing to a link would replace its target
    if real.suffix.lower() not in PAIR_SUFFIXES:
        name = real.with_suffix(".h5").name
        raise ParameterError(f"`{real.name}` must end in .h5 or .hdf5: `{name}`.")


class PairWriter:
    """Writer of a file of pairs, from `PairFile.create`.

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
        if dtype not in ("uint8", "uint16", "float32"):
            raise ParameterError(f"`dtype` ('{dtype}') must be 'uint8', 'uint16' or 'float32'.")
        for name, shape in zip(PAIR_PARTS, shapes, strict=True):
            if len(shape) != 3 or min(shape) < 1:
                raise ParameterError(f"`{name}_shape` {tuple(shape)} must be (height, width, channels), all positive.")
            if shape[2] not in (1, 3):
                raise ParameterError(
                    f"`{name}_shape` {tuple(shape)} must have 1 channel or 3: a `PairFile` has no others."
                )
            if np.dtype(dtype).itemsize * math.prod(shape) > PICTURE_BYTES:
                raise ParameterError(
                    f"`{name}_shape` {tuple(shape)} must have {PICTURE_BYTES:,} bytes at most: crop it."
                )
        for key, value in attributes.items():
            if not isinstance(value, str | int | float) or key == VERSION_KEY:
                raise ParameterError(f"`attributes` must hold text and numbers; '{key}' is {type(value).__name__}.")
        self.path, self.dtype = path, np.dtype(dtype)
        self._shapes = dict(zip(PAIR_PARTS, shapes, strict=True))
        self._attributes, self._psf = attributes, _psf_array(psf)
        self._stack = ExitStack()
        self._data: dict[str, Any] = {}
        self._disk: CheckedFile | None = None
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def __enter__(self) -> "PairWriter":
        with as_image_error(self.path), ExitStack() as stack:
            file, self._disk = stack.enter_context(create_hdf5(stack.enter_context(atomic(self.path))))
            self._set_up(file)
            self._stack = stack.pop_all()
        return self

    def _set_up(self, file: Any) -> None:  # noqa: ANN401
        """Make the data sets of an `h5py.File`, without rows."""
        file.attrs.update({VERSION_KEY: FORMAT_VERSION, **self._attributes})
        for name, shape in self._shapes.items():
            self._data[name] = add_rows(file, name, shape, self.dtype)
        if self._psf is not None:
            file.create_dataset("psf", data=self._psf, track_times=False)

    def _stored(self, pixels: Frame) -> Frame:
        """A sample (H, W, C) in the axes and channels of the file."""
        return pixels

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The stack removes the hidden file; an exception from the body of the ``with`` statement is raised unchanged.
        with as_image_error(self.path, f" at the end, after {self._length:,} pairs"):
            self._stack.__exit__(kind, error, trace)
        self._disk, self._data = None, {}

    def append(self, measurement: Tensor | Frame, scene: Tensor | Frame) -> None:
        """Add a pair, or a batch of pairs. Each is on the disk before the next one is taken.

        Args:
            measurement: a tensor (B, C, H, W) or (C, H, W), or an array (B, H, W, C) or (H, W, C). Floats are
                nominally in [0, 1]; integers are fractions of their type's maximum.
            scene: likewise, as many as measurements.

        Raises:
            ShapeError: the size is not the file's, or the numbers of scenes and measurements differ.
            ParameterError: no tensor or array, NaN, or numbers on another scale than [0, 1].
            ImageError: the file cannot be written, or is not open.
        """
        if self._disk is None:
            raise ImageError(f"`{self.path}` is not open. Append inside `with PairFile.create(...) as file:`.")
        rows = [self._rows(name, pixels) for name, pixels in zip(PAIR_PARTS, (measurement, scene), strict=True)]
        if len(rows[0]) != len(rows[1]):
            raise ShapeError(
                f"`measurement` ({len(rows[0])}) and `scene` ({len(rows[1])}) must match. Append whole pairs."
            )
        for pair in zip(*rows, strict=True):
            with as_image_error(self.path, f" at pair {self._length + 1:,}"):
                self._write(dict(zip(PAIR_PARTS, pair, strict=True)))
            self._length += 1

    def _write(self, pair: dict[str, Frame]) -> None:
        for name, pixels in pair.items():
            write_row(self._data[name], self._stored(pixels))
        if self._disk is not None:
            self._disk.check()

    def _rows(self, name: str, pixels: Tensor | Frame) -> Frame:
        """Convert to (B, H, W, C) in the type of the file."""
        if isinstance(pixels, Tensor):
            # numpy has no bfloat16, which autocast may give.
            stored = pixels.detach().cpu().to(torch.float32 if pixels.dtype == torch.bfloat16 else pixels.dtype)
            array = stored.movedim(-3, -1).numpy() if stored.ndim >= 3 else stored.numpy()
        elif isinstance(pixels, np.ndarray):
            array = pixels
        else:
            raise ParameterError(f"`{name}` ({shown(pixels)}) must be a tensor or an array. A list: `numpy.asarray`.")
        batch = array[None] if array.ndim == 3 else array
        if batch.ndim != 4 or batch.shape[1:] != self._shapes[name]:
            got, wanted = (" x ".join(map(str, shape)) for shape in (array.shape, self._shapes[name]))
            raise ShapeError(
                f"`{name}` ({got}: height, width, channels) must be {wanted}, as in `{self.path}`. Crop or resize it."
            )
        return quantise(batch, self.dtype, name, has_flat=name == "measurement" and self.dtype.kind == "f")


def quantise(pixels: Frame, dtype: np.dtype[Any], name: str = "pixels", *, has_flat: bool = False) -> Frame:
    """Convert pixels to another type; 1 corresponds to the maximum of an integer type.

    Args:
        pixels: uint8, uint16, or floats nominally in [0, 1].
        dtype: uint8 and uint16 clip to [0, 1] and round; float32 keeps numbers slightly outside of it.
        name: of the pixels, for the error message.
        has_flat: a flat field may have brightened them, where it is dark.

    Raises:
        ParameterError: NaN, infinity, another type, or numbers on another scale.
    """
    if pixels.dtype == dtype and dtype.kind == "u":
        return pixels
    if pixels.dtype.kind == "u" and pixels.dtype.itemsize <= 2:
        pixels = pixels / np.float32(np.iinfo(pixels.dtype).max)
    elif pixels.dtype.kind != "f":
        raise ParameterError(f"`{name}` ({pixels.dtype}) must be floats, uint8 or uint16. Convert it with `astype`.")
    low, high = (float(pixels.min()), float(pixels.max())) if pixels.size else (0.0, 0.0)
    if not (low >= _LOWEST and high <= (_HIGHEST / MIN_RESPONSE if has_flat else _HIGHEST)):  # NaN fails this too
        raise ParameterError(f"`{name}` ({low:.4g} to {high:.4g}) must be in [0, 1]. Divide it by its full scale.")
    if dtype.kind == "f":
        return pixels.astype(dtype)
    return np.rint(pixels.clip(0, 1) * np.float64(np.iinfo(dtype).max)).astype(dtype)


def _psf_array(psf: Tensor | None) -> Frame | None:
    if psf is None:
        return None
    if not isinstance(psf, Tensor):
        raise ParameterError(f"`psf` ({shown(psf)}) must be a tensor (C, H, W), as `Calibration.psf` is.")
    picture = psf[0] if psf.ndim == 4 and len(psf) == 1 else psf
    if picture.ndim != 3:
        raise ShapeError(f"`psf` {tuple(psf.shape)} must be (C, H, W) or (1, C, H, W).")
    return picture.detach().to("cpu", torch.float32).numpy()
