"""Files of a camera's PSFs at other distances and other places of the field."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PlaceFiles:
    """PSFs of points elsewhere, in the format of the camera's own PSF; read when they are needed.

    Args:
        distances_mm: distances of points on the axis, other than the camera's own.
        distance_psfs: their files.
        field_positions: displacements (down, right) of points off the axis, in pixels of the raw frame: where the
            reconstruction shows them, relative to its centre.
        field_psfs: their files; each PSF is centred like the one on the axis.
    """

    distances_mm: tuple[float, ...] = ()
    distance_psfs: tuple[Path, ...] = ()
    field_positions: tuple[tuple[float, float], ...] = ()
    field_psfs: tuple[Path, ...] = ()
