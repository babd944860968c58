"""Pictures that calibrate a camera and its display: dark, white, grey steps, a point, dots, a ChArUco board."""

from collections.abc import Callable, Mapping

import numpy as np

from mwdn.capture.screen import Picture, Screen
from mwdn.errors import ParameterError, UnknownNameError

SQUARES = 7
"""Squares along each side of the ChArUco board, of the dictionary DICT_4X4_50; markers have 3/4 of a square."""

MIN_BOARD_PX = 12 * SQUARES
"""Least side of a picture for the board: 12 pixels a square give a marker 9 pixels, 1.5 for each of its 6 x 6 cells."""

DOTS = 7
"""Dots along each side; the first two have twice the diameter of the others, so that turns and mirrors are noticed."""

GREY_STEPS = 9
"""Grey steps from black to white by which a display's gamma is measured."""


def grey(level: int, size: tuple[int, int]) -> Picture:
    """A picture (height, width) of one grey level, 0 (dark) to 255 (white)."""
    return np.full((*size, 3), level, np.uint8)


def grey_levels() -> list[int]:
    """Levels of the grey steps, evenly from 0 to 255."""
    return [round(255 * step / (GREY_STEPS - 1)) for step in range(GREY_STEPS)]


def point(screen: Screen, size_cm: float = 0.1) -> Picture:
    """A white square in the middle of a black display: a point source for the PSF.

    Args:
        screen: the display.
        size_cm: side of the square. At 20 cm, 0.1 cm is 0.3 degrees: smaller than the PSF's finest line must be, or
            the PSF is blurred by it.

    Raises:
        ParameterError: it is larger than the display.
    """
    canvas = grey(0, (screen.height_px, screen.width_px))
    edges = []
    for per_cm, length in zip(screen.px_per_cm, (screen.width_px, screen.height_px), strict=True):
        side = max(round(size_cm * per_cm), 1)
        if side > length:
            raise ParameterError(
                f"A point of `size_cm` {size_cm:g} must be on the display, {screen.width_cm} x {screen.height_cm} cm. "
                "Make it smaller."
            )
        first = round(length / 2 - side / 2)
        edges.append(slice(first, first + side))
    canvas[edges[1], edges[0]] = 255
    return canvas


def dot_centres(size: tuple[int, int]) -> np.ndarray:
    """(DOTS^2, 2), x and y of the dots' centres in pixels of a picture (height, width), row by row."""
    steps = (np.arange(DOTS) + 0.5) / DOTS
    x, y = np.meshgrid(steps * size[1] - 0.5, steps * size[0] - 0.5)
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def dots(size: tuple[int, int]) -> Picture:
    """White dots on black, on a grid over the whole picture (height, width), with smooth edges."""
    y, x = np.mgrid[: size[0], : size[1]]
    light = np.zeros(size)
    for number, (column, row) in enumerate(dot_centres(size)):
        radius = min(size) / DOTS / (4 if number < 2 else 8)
        distance = np.hypot(x - column, y - row)
        light = np.maximum(light, np.clip(radius + 0.5 - distance, 0, 1))
    return np.repeat(np.rint(255 * light).astype(np.uint8)[..., None], 3, axis=-1)


def charuco(size: tuple[int, int]) -> Picture:
    """A ChArUco board that fills the largest square in the middle of a picture (height, width); white around it.

    References:
        S. Garrido-Jurado et al., Pattern Recognition 47, 2280 (2014), for the markers.
    """
    from cv2 import aruco

    side = min(size) // SQUARES * SQUARES
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_4X4_50)
    board = np.asarray(aruco.CharucoBoard((SQUARES, SQUARES), 1.0, 0.75, dictionary).generateImage((side, side)))
    picture = np.full(size, 255, np.uint8)
    top, left = (size[0] - side) // 2, (size[1] - side) // 2
    picture[top : top + side, left : left + side] = board
    return np.repeat(picture[..., None], 3, axis=-1)


PATTERNS: Mapping[str, Callable[[tuple[int, int]], Picture]] = {
    "dark": lambda size: grey(0, size),
    "white": lambda size: grey(255, size),
    "dots": dots,
    "charuco": charuco,
}
"""Patterns by name that fill a picture of any size."""


def check_size(name: str, size: tuple[int, int]) -> None:
    """Raise a `ParameterError` if a picture of this height and width is too small for a pattern."""
    if name == "charuco" and min(size) < MIN_BOARD_PX:
        raise ParameterError(
            f"`size` ({size[0]} x {size[1]}) of [pictures] must be at least {MIN_BOARD_PX} x {MIN_BOARD_PX} pixels for "
            'a ChArUco board. Enlarge it, or leave the board out: `patterns = ["dots"]` in [session].'
        )


def pattern(name: str, size: tuple[int, int]) -> Picture:
    """A pattern of `PATTERNS`, of this height and width.

    Raises:
        UnknownNameError: there is none of this name.
        ParameterError: the picture is too small for it.
    """
    if name not in PATTERNS:
        raise UnknownNameError("pattern", name, PATTERNS)
    check_size(name, size)
    return PATTERNS[name](size)
