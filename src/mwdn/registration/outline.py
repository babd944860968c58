"""The outline of a bright display in a reconstruction, where the displayed picture is not known.

The brightest large region gives a first quadrilateral. Each side is then a line through the strongest falls of
brightness along profiles across it. Most profiles must agree: dark parts of the picture at the border, reflections
beside it and ringing of the reconstruction disturb a few.

A prior that removes haze (positive light, sparse gradients, a network) also removes dark parts of the picture at its
border: in a picture of a display by the paper's camera, a strip of a tenth of its height. A Wiener estimate is linear:
it keeps the edge of these parts, under haze without an edge.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from mwdn.errors import AlignmentError
from mwdn.registration.projection import Points
from mwdn.types import FloatFrame

_THRESHOLDS = (0.5, 0.35, 0.25)
"""Of the region's brightness: first candidates, the strictest first."""

_SMALLEST = 0.01
"""Smallest display, as a fraction of the frame."""

_PROFILES = 48
_MIN_PROFILES = 4
_REACH = 0.12
"""Length of a profile on each side of the line, as a fraction of the display's size."""

_TOLERANCE_PX = 1.5
_AGREEING = 0.5
"""Fewest profiles of each side whose edge lies within the tolerance of the line."""

_CERTAIN = 0.9
"""Likewise in a linear estimate, whose haze and noise also have edges: those agreed to 0.83 at most in simulations."""


def find_outline(reconstruction: FloatFrame, linear: FloatFrame | None = None) -> Points:
    """Corners of the bright quadrilateral.

    Args:
        reconstruction: (H, W), square root of linear light.
        linear: (H, W), linear light of a Wiener estimate. The sides are taken from it if nearly all profiles agree.

    Returns:
        (4, 2), x and y in pixels, clockwise as seen, from the corner that is closest to the top left.

    Raises:
        AlignmentError: there is no bright region with four straight sides.
    """
    starts = [_rough(reconstruction, threshold) for threshold in _THRESHOLDS]
    best, agreement = _straightest(linear, starts) if linear is not None else (None, 0.0)
    if agreement < _CERTAIN:
        best, agreement = _straightest(reconstruction, starts)
    if best is None or agreement < _AGREEING:
        raise AlignmentError(
            "No bright display with four straight sides was found in the reconstruction. Give the displayed picture, "
            "`mwdn align CAPTURE PICTURE`, or pick its four corners: `--points`."
        )
    return np.roll(best, -int(best.sum(1).argmin()), 0)


def _straightest(image: FloatFrame, starts: list[Points | None]) -> tuple[Points | None, float]:
    """The corners whose sides fit the profiles best, and the share of profiles that agree with the worst side."""
    fits = [_sharpen(image, start) for start in starts if start is not None]
    return max(fits, key=lambda fit: fit[1], default=(None, 0.0))


def _rough(image: FloatFrame, threshold: float) -> Points | None:
    """A quadrilateral around the largest bright region, or ``None``."""
    import cv2

    size = max(image.shape)
    smooth = cv2.GaussianBlur(image, (0, 0), size / 160)
    bright = float(np.quantile(smooth, 0.98))
    mask = (smooth > threshold * bright).astype(np.uint8)
    reach = 2 * round(size / 40) + 1
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, (reach, reach)))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_RECT, (reach, reach)))
    contours, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    largest: Any = max(contours, key=lambda contour: _light_inside(smooth, contour))
    if cv2.contourArea(largest) < _SMALLEST * image.size:
        return None
    corners = cv2.boxPoints(cv2.minAreaRect(largest)).astype(np.float64)
    return corners if _area(corners) > 0 else corners[::-1].copy()


def _light_inside(image: Any, contour: Any) -> float:  # noqa: ANN401
    import cv2

    mask = np.zeros(image.shape, np.uint8)
    cv2.drawContours(mask, [contour], -1, 1, -1)
    return float(image[mask > 0].sum())


def _sharpen(image: FloatFrame, corners: Points) -> tuple[Points, float]:
    """Fit each side to the falls of brightness, three times; and the least share of profiles that agree."""
    share = 0.0
    for reach in (_REACH, _REACH / 2, _REACH / 3):
        size = float(np.sqrt(abs(_area(corners))))
        fits = [_side(image, corners[i], corners[(i + 1) % 4], reach * size) for i in range(4)]
        lines, shares = zip(*fits, strict=True)
        crossings = [np.cross(lines[i - 1], lines[i]) for i in range(4)]
        if any(abs(point[2]) < 1e-9 for point in crossings):
            return corners, 0.0
        moved = np.array([point[:2] / point[2] for point in crossings])
        if np.abs(moved - corners).max() > 0.5 * size:
            return corners, 0.0
        corners, share = moved, min(shares)
    return corners, share


def _side(image: FloatFrame, start: Points, end: Points, reach: float) -> tuple[npt.NDArray[np.float64], float]:
    """The line (a, b, c), ``a x + b y + c = 0``, of the side from start to end; and the share of profiles on it."""
    import cv2

    along = end - start
    outwards = np.array([along[1], -along[0]]) / max(float(np.hypot(*along)), 1e-9)
    offsets = np.arange(-reach, reach + 0.25, 0.5)
    places = start + np.linspace(0.06, 0.94, _PROFILES)[:, None] * along
    x, y = np.moveaxis(places[:, None] + offsets[:, None] * outwards, -1, 0).astype(np.float32)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    profiles = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    fall = -np.gradient(profiles, axis=1)
    where = fall.argmax(1)
    strength = fall[np.arange(_PROFILES), where]
    edges = places + _peak(fall, where, offsets)[:, None] * outwards
    strong = strength > 0.25 * np.quantile(strength, 0.9)
    if strong.sum() < _MIN_PROFILES:  # nothing falls outwards here: there is no side
        return np.array([0.0, 0.0, 1.0]), 0.0
    vx, vy, x0, y0 = _robust_line(edges[strong])
    normal = np.array([-vy, vx])
    distance = np.abs((edges - [x0, y0]) @ normal)
    return np.array([*normal, -normal @ [x0, y0]]), float(((distance < _TOLERANCE_PX) & strong).mean())


def _peak(fall: FloatFrame, where: npt.NDArray[np.int64], offsets: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Offsets of the maxima, by the parabola through three values."""
    rows, inner = np.arange(len(fall)), np.clip(where, 1, fall.shape[1] - 2)
    left, middle, right = (fall[rows, inner + d].astype(np.float64) for d in (-1, 0, 1))
    bend = left - 2 * middle + right
    part = np.where(bend < -1e-9, 0.5 * (left - right) / np.where(bend < -1e-9, bend, 1), 0.0)
    return offsets[inner] + np.clip(part, -1, 1) * (offsets[1] - offsets[0])


def _robust_line(points: Points) -> tuple[float, float, float, float]:
    """Direction and a point of the line with most points, by pairs of points, then Huber's fit to those near it."""
    import cv2

    i, j = np.triu_indices(len(points), len(points) // 3)
    along = points[j] - points[i]
    normals = np.stack([-along[:, 1], along[:, 0]], -1) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    distances = np.abs(points @ normals.T - (points[i] * normals).sum(-1))
    best = (distances < _TOLERANCE_PX).sum(0).argmax()
    near = points[distances[:, best] < _TOLERANCE_PX]
    vx, vy, x0, y0 = cv2.fitLine(near.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().tolist()
    return vx, vy, x0, y0


def _area(corners: Points) -> float:
    """Signed area: positive if clockwise as seen, y downwards."""
    x, y = corners.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
