"""A registration, a projection with its quality: as a file, and in words."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mwdn.data.hdf5 import open_hdf5_header, read_attributes
from mwdn.data.pair_writer import PAIR_SUFFIXES
from mwdn.errors import ParameterError
from mwdn.io.reading import parse_json, read_json, unexpected_content
from mwdn.registration.projection import Points, Projection, side_vectors

KEY = "registration"
"""Attribute of a file of aligned pairs that holds the registration as JSON."""


@dataclass(frozen=True)
class Place:
    """Where a displayed picture is in the camera's frame, in everyday terms.

    Args:
        left: of the picture's corner that is the top left one as seen, in pixels.
        top: likewise.
        width: mean length of its upper and lower side as seen.
        height: mean length of its left and right side.
        turn_degrees: clockwise, -45 to 45 for an outline, -180 to 180 for a known picture.
        mirrored: whether the camera sees its mirror image.
    """

    left: float
    top: float
    width: float
    height: float
    turn_degrees: float
    mirrored: bool = False

    @classmethod
    def of(cls, corners: Points) -> "Place":
        """The place of a picture with these corners (4, 2): its own top left, top right, bottom right, bottom left."""
        top, right, bottom, left = side_vectors(corners)
        mirrored = top[0] * right[1] - top[1] * right[0] < 0
        along = top - bottom  # the picture's own rows
        if mirrored:
            along = -along
        turn = np.degrees(np.arctan2(along[1], along[0]))
        first = corners[corners.sum(1).argmin()]
        upright = abs((turn + 90) % 180 - 90) <= 45
        across, down = ((np.hypot(*a) + np.hypot(*b)) / 2 for a, b in ((top, bottom), (right, left)))
        width, height = (across, down) if upright else (down, across)
        return cls(float(first[0]), float(first[1]), float(width), float(height), float(turn), bool(mirrored))

    def __str__(self) -> str:
        mirrored = ", mirrored left to right" if self.mirrored else ""
        return (
            f"{self.width:.1f} x {self.height:.1f} px (width x height), top left at ({self.left:.1f}, {self.top:.1f}), "
            f"turned by {self.turn_degrees:.2f} degrees{mirrored}"
        )


def read_projection(path: str | Path) -> Projection:
    """Read the projection of a registration from its JSON file, or from a file of aligned pairs.

    Raises:
        ParameterError: a JSON file cannot be read; or the file holds none, or is damaged.
        ImageError: a file of pairs cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() in PAIR_SUFFIXES:
        advice = "Align again: `mwdn align`."
        with open_hdf5_header(path, advice) as file:
            attributes = read_attributes(path, file, advice)
        if KEY not in attributes:
            raise ParameterError(f"`{path}` has no `{KEY}`: it was not written by `mwdn align`. Align it first.")
        content = parse_json(str(attributes[KEY]), path)
    else:
        content = read_json(path)
    with unexpected_content(path):
        return Projection.from_dict(content)
