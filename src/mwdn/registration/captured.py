"""Captured pairs before they are aligned: raw frames of the camera, and the pictures that were on the display."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mwdn.calibration import Calibration
from mwdn.data.hdf5 import as_damage, find_rows, open_hdf5
from mwdn.data.pair_writer import PAIR_PARTS
from mwdn.data.pairs import PairFile
from mwdn.errors import ImageError, ParameterError
from mwdn.io.images import srgb_decode
from mwdn.registration.registration import KEY
from mwdn.types import Frame, Image, Measurement

_ADVICE = "Capture it again: `mwdn capture`."

_PATTERNS = ("charuco", "dots")
_FRAMES = 16
"""Largest number of averaged frames of a pattern, and of the dark display."""

SRGB = "srgb"


class SessionPairs:
    """The pairs of a session as the camera and the display had them. Use it in a ``with`` statement.

    Args:
        path: HDF5 with ``measurement``, raw frames (N, H, W, C), and ``scene``, displayed pictures (N, h, w, C).
        calibration: of the camera; bit depth and mosaic are the session's if the calibration has none.
        display_gamma: light of the display is the stored number to this power, or ``"srgb"``. `mwdn capture` stores
            the light itself, as every file of pairs does.

    Raises:
        ImageError: no such file, damaged, or not of pairs; it holds none.
        ParameterError: the pairs are aligned already, or the gamma is not a power from 0.5 to 4.
    """

    def __init__(self, path: Path, calibration: Calibration, *, display_gamma: float | str = 1.0) -> None:
        self.path = path
        with PairFile(path) as file:
            attributes, self._count = file.attributes, len(file)
            self.picture_size = file.scene_shape[0], file.scene_shape[1]
        if KEY in attributes:
            raise ParameterError(f"`{path}` is aligned already. Give the file of `mwdn capture` that it was made from.")
        if not self._count:
            raise ImageError(f"`{path}` holds no pair. {_ADVICE}")
        frames = calibration.frames.completed(attributes.get("bit_depth"), attributes.get("mosaic"), of=f"`{path}`")
        self.calibration = _with_ambient(path, replace(calibration, frames=frames))
        self.display_gamma = as_gamma(display_gamma)
        self._file: Any = None
        self._rows: dict[str, Any] = {}

    def __len__(self) -> int:
        return self._count

    def __enter__(self) -> "SessionPairs":
        self._file = open_hdf5(self.path, _ADVICE)
        self._rows = {name: find_rows(self.path, self._file, name, _ADVICE) for name in PAIR_PARTS}
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._file, self._rows = None, {}

    def measurement(self, number: int) -> Measurement:
        """(1, C, H, W), linear light, as the calibration corrects the raw frame.

        Raises:
            MwdnError: the frame is damaged, or does not fit the camera.
        """
        return self.calibration.correct(self._read("measurement", number))

    def picture(self, number: int) -> Image:
        """(1, C, h, w), linear light of the displayed picture, white 1.

        Raises:
            ImageError: it is damaged.
        """
        return as_light(self._read("scene", number), self.display_gamma)[None]

    def patterns(self) -> Iterator[tuple[Measurement, Image]]:
        """Mean measurement and light of each pattern for alignment that the session has.

        Raises:
            MwdnError: as for `measurement` and `picture`.
        """
        for name in _PATTERNS:
            parts = [find_rows(self.path, self._file, f"patterns/{name}/{part}", _ADVICE) for part in PAIR_PARTS]
            if None in parts or not all(map(len, parts)) or parts[1].shape[1:3] != self.picture_size:
                continue
            with as_damage(f"`patterns/{name}` of `{self.path}` cannot be read", _ADVICE):
                frames, picture = parts[0][:_FRAMES], parts[1][0]
            measurements = [self.calibration.correct(frame) for frame in frames]
            yield torch.stack(measurements).mean(0), as_light(picture, self.display_gamma)[None]

    def _read(self, name: str, number: int) -> Frame:
        with as_damage(f"`{name}` {number} of `{self.path}` cannot be read", _ADVICE):
            return np.asarray(self._rows[name][number])


def _with_ambient(path: Path, calibration: Calibration) -> Calibration:
    """The calibration with the session's frames of a dark display as its ambient frame, unless it has one."""
    if calibration.ambient is not None:
        return calibration
    with open_hdf5(path, _ADVICE) as file:
        rows = find_rows(path, file, "references/ambient/measurement", _ADVICE)
        if rows is None or not len(rows):
            return calibration
        with as_damage(f"`references/ambient` of `{path}` cannot be read", _ADVICE):
            frames = [rows[int(number)] for number in np.linspace(0, len(rows) - 1, min(len(rows), _FRAMES))]
    images = [calibration.frames.normalise(frame) for frame in frames]
    return replace(calibration, ambient=torch.stack(images).mean(0))


def as_light(picture: Frame, gamma: float | str) -> Tensor:
    """Linear light (C, h, w) of a displayed picture (h, w, C), white 1; integers are fractions of their maximum."""
    scale = np.float32(np.iinfo(picture.dtype).max) if picture.dtype.kind == "u" else np.float32(1)
    light = torch.from_numpy(picture.astype(np.float32) / scale).movedim(-1, 0).clamp(min=0)
    return srgb_decode(light) if gamma == SRGB else light ** float(gamma)


def as_gamma(gamma: float | int | str) -> float | str:
    """A gamma of a display: "srgb" or a power.

    Raises:
        ParameterError: it is neither, or not from 0.5 to 4.
    """
    if gamma == SRGB:
        return SRGB
    try:
        power = float(gamma)
    except ValueError:
        power = float("nan")
    if not 0.5 <= power <= 4:
        raise ParameterError(f"`display_gamma` ({gamma}) must be srgb, or a power from 0.5 to 4.")
    return power
