"""Write the MWDN authors' HDF5 file, as their code reads it; `mwdn import mwdn` reads it."""

from pathlib import Path
from typing import Any

from mwdn.data.hdf5 import add_rows
from mwdn.data.pair_writer import PairWriter, Shape
from mwdn.errors import ShapeError
from mwdn.types import Frame

AUTHORS_NAMES = {"measurement": "blur", "scene": "gt"}
"""Names of the data sets in the authors' files."""


class AuthorsWriter(PairWriter):
    """Writer of the authors' file: ``blur`` and ``gt``, (N, 3, H, W), uint8, blue first.

    Their training divides it by position: the first tenth is the test, the second the validation.

    Args:
        path: ends in .h5 or .hdf5.
        measurement_shape: (H, W, C) of the measurements.
        scene_shape: (H, W, C) of the scenes.

    Raises:
        ShapeError: the scenes have another shape than the measurements, which the authors' code does not take.
    """

    def __init__(self, path: Path, measurement_shape: Shape, scene_shape: Shape) -> None:
        if measurement_shape != scene_shape:
            sizes = (" x ".join(map(str, shape)) for shape in (scene_shape, measurement_shape))
            raise ShapeError(
                "The scenes of the authors' file ({}) must have the size of its measurements ({}). Give "
                "`--scene-place TOP LEFT` if they show a part of the frame.".format(*sizes)
            )
        super().__init__(path, (measurement_shape, scene_shape), "uint8", {}, None)

    def _set_up(self, file: Any) -> None:  # noqa: ANN401
        for name, (height, width, channels) in self._shapes.items():
            self._data[name] = add_rows(file, AUTHORS_NAMES[name], (channels, height, width), self.dtype)

    def _stored(self, pixels: Frame) -> Frame:
        return pixels[..., ::-1].transpose(2, 0, 1)
