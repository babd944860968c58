"""A projection from the ArUco markers of a displayed board (ChArUco or a grid of markers)."""

from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np

from mwdn.errors import AlignmentError
from mwdn.registration.point_fit import fit_points
from mwdn.registration.projection import Points, Projection
from mwdn.registration.views import Bytes, Views

_DICTIONARIES = ("4X4_50", "4X4_100", "5X5_50", "5X5_100", "6X6_250", "ARUCO_ORIGINAL", "APRILTAG_36h11")
_MARKER_PX = 1200
"""Reconstructions are enlarged to this many pixels a side: a marker of 4 x 4 bits then has enough for its bits."""


def match_markers(views: Views) -> list[Projection]:
    """The projection that the corners of at least two markers give: none if no board is displayed or seen."""
    displayed, seen = [], []
    for picture, reconstruction in zip(*views.bytes, strict=True):
        name, markers = _board(picture)
        if len(markers) < 2:
            continue
        by_number = _detect_either_way(reconstruction, name)
        common = [number for number in markers if number in by_number]
        displayed += [markers[number] for number in common]
        seen += [by_number[number] for number in common]
    if len(displayed) < 2:
        return []
    points = np.concatenate(displayed), np.concatenate(seen)
    with suppress(AlignmentError):
        return [fit_points(*points, picture_size=views.picture_size, camera_size=views.camera_size).projection]
    return []


def _board(picture: Bytes) -> tuple[str, dict[int, Points]]:
    """Dictionary and markers of a displayed picture."""
    boards = {name: _detect(picture, name) for name in _DICTIONARIES}
    name = max(boards, key=lambda each: len(boards[each]))
    return name, boards[name]


def _detect_either_way(seen: Bytes, name: str) -> dict[int, Points]:
    """Markers of a reconstruction, which may be mirrored."""
    factor = max(1, round(_MARKER_PX / max(seen.shape)))
    plain, mirrored = _detect(seen, name, factor), _detect(seen[:, ::-1], name, factor)
    if len(plain) >= len(mirrored):
        return plain
    return {number: (corners * [-1, 1] + [seen.shape[1] - 1, 0]) for number, corners in mirrored.items()}


def _detect(image: Bytes, name: str, factor: int = 1) -> dict[int, Points]:
    """Corners (4, 2) of each marker by its number, in pixels of the image."""
    import cv2

    large = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    corners, numbers, _ = _detector(name).detectMarkers(np.ascontiguousarray(large))
    numbers = [] if numbers is None else numbers.ravel().tolist()
    return {
        int(number): (corner.reshape(4, 2).astype(np.float64) + 0.5) / factor - 0.5
        for number, corner in zip(numbers, corners, strict=True)
    }


@cache
def _detector(name: str) -> Any:  # noqa: ANN401
    from cv2 import aruco

    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    return aruco.ArucoDetector(aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{name}")), parameters)
