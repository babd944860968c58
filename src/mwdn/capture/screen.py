"""A display in front of a camera: its size, where pictures are on it, and the projection to the camera's pixels."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mwdn.errors import ParameterError

Homography = npt.NDArray[np.float64]
"""(3, 3), from (x, y, 1) of one picture's pixels to another's; whole numbers are centres of pixels."""

Picture = npt.NDArray[np.uint8]
"""(H, W, 3), RGB, as the display is sent it: coded, not linear."""


@dataclass(frozen=True, kw_only=True)
class Screen:
    """A flat display.

    Args:
        width_px: pixels.
        height_px: likewise.
        width_cm: lit width in centimetres.
        height_cm: likewise.
        distance_cm: from the camera to the middle of the display.

    Raises:
        ParameterError: a number is not positive.
    """

    width_px: int = 480
    height_px: int = 270
    width_cm: float = 48.0
    height_cm: float = 27.0
    distance_cm: float = 20.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ParameterError(f"`{name}` ({value}) of the display must be positive.")

    @property
    def px_per_cm(self) -> tuple[float, float]:
        """Pixels per centimetre, across and down; they differ if the display stretches its picture."""
        return self.width_px / self.width_cm, self.height_px / self.height_cm

    def to_cm(self) -> Homography:
        """From pixels to centimetres on the display, from its middle to the right and down."""
        (across, down), (x, y) = self.px_per_cm, ((self.width_px - 1) / 2, (self.height_px - 1) / 2)
        return np.array([[1 / across, 0, -x / across], [0, 1 / down, -y / down], [0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class DisplayPose:
    """How a display stands in front of a camera.

    Args:
        tilt_degrees: rotation about the horizontal axis (its upper edge goes away), then about the vertical axis (its
            right edge comes nearer).
        turn_degrees: rotation in its plane, clockwise as the camera sees it.
        offset_cm: of its middle from the camera's axis, right and down.
    """

    tilt_degrees: tuple[float, float] = (0.0, 0.0)
    turn_degrees: float = 0.0
    offset_cm: tuple[float, float] = (0.0, 0.0)

    def rotation(self) -> Homography:
        """(3, 3), of (right, down, away)."""
        a, b = (math.radians(angle) for angle in self.tilt_degrees)
        c = math.radians(self.turn_degrees)
        about_x = np.array([[1, 0, 0], [0, math.cos(a), math.sin(a)], [0, -math.sin(a), math.cos(a)]])
        about_y = np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
        about_z = np.array([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
        return about_z @ about_y @ about_x


def project(screen: Screen, pose: DisplayPose, size: tuple[int, int], focal_px: float) -> Homography:
    """Homography from a display's pixels to a camera's: exact for a thin mask.

    A point at (X, Y, Z) casts its pattern displaced by ``focal_px (X, Y) / Z`` from the middle ``(H // 2, W // 2)``.

    Args:
        screen: the display.
        pose: of the display.
        size: height and width of the camera's measurements.
        focal_px: distance of the mask from the sensor, in pixels of a measurement.
    """
    rotation, (right, down) = pose.rotation(), pose.offset_cm
    # Columns: the display's two axes, and its middle; its own third coordinate is 0.
    plane = np.column_stack([rotation[:, 0], rotation[:, 1], (right, down, screen.distance_cm)])
    camera = np.array([[focal_px, 0, size[1] // 2], [0, focal_px, size[0] // 2], [0, 0, 1.0]])
    whole: Any = camera @ plane @ screen.to_cm()
    return whole / whole[2, 2]


@dataclass(frozen=True)
class Place:
    """Where pictures are on a display, in its pixels.

    Args:
        left: first column.
        top: first row.
        width: in pixels.
        height: in pixels.
    """

    left: int
    top: int
    width: int
    height: int


def place_picture(screen: Screen, size: tuple[int, int], fill: float) -> Place:
    """The largest place of a picture's proportions (in centimetres) within a part of the display, in its middle.

    Args:
        screen: the display.
        size: height and width of the picture, whose pixels are square.
        fill: of the display's width or height, up to 1.

    Raises:
        ParameterError: ``fill`` is not in (0, 1].
    """
    if not 0 < fill <= 1:
        raise ParameterError(f"`fill` ({fill}) must be above 0 and at most 1: a part of the display.")
    across, down = screen.px_per_cm
    cm = fill * min(screen.width_cm / size[1], screen.height_cm / size[0])  # of a pixel of the picture
    width, height = max(round(size[1] * cm * across), 1), max(round(size[0] * cm * down), 1)
    return Place((screen.width_px - width) // 2, (screen.height_px - height) // 2, width, height)


def put(picture: Picture, place: Place, screen: Screen) -> Picture:
    """A black canvas of the display's size with a picture at a place.

    Enlarged by repeated pixels or interpolated, whichever keeps the picture's light: a whole factor repeats.
    """
    import cv2

    canvas = np.zeros((screen.height_px, screen.width_px, 3), np.uint8)
    size = place.width, place.height
    whole = place.width % picture.shape[1] == 0 and place.height % picture.shape[0] == 0
    smaller = place.width < picture.shape[1]
    how = cv2.INTER_NEAREST if whole else cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    spread = np.asarray(cv2.resize(picture, size, interpolation=how)).reshape(place.height, place.width, -1)
    canvas[place.top : place.top + place.height, place.left : place.left + place.width] = spread
    return canvas
