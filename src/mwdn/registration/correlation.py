"""Refine a projection by maximising the correlation of displayed pictures and reconstructions (ECC).

With T the displayed pictures and I the reconstructions, sampled at ``m(p; theta)`` of `mwdn.registration.projection`,
minimise over theta, and over a gain a and an offset b of each picture

1. ``E(theta) = sum_n sum_p w (I_n(m(p; theta)) - a_n T_n(p) - b_n)^2``

Gain and offset are eliminated exactly (variable projection), which makes the minimum of (1) the maximum of the
correlation coefficient. All pictures share theta: artefacts differ from picture to picture and cancel. The weights w
are Tukey's: what no gain explains, such as a reflection beside the display, has none.
"""

from contextlib import suppress
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mwdn.errors import AlignmentError, ParameterError
from mwdn.registration.projection import Points, Projection, side_vectors
from mwdn.registration.views import Views, compress
from mwdn.types import FloatFrame, Size

Array = npt.NDArray[np.float64]

DARK_RIM = 0.08
"""Dark rim around the displayed picture, as a fraction of its size, that is compared, too, because the border is an
edge."""

FINE_BLUR = 1.0
"""Standard deviation in pixels of the camera of the Gaussian under which a fit is judged."""

_OWN_BLURS = (0.0, 0.7, 1.4, 2.1, 3.0)
"""Standard deviations of a reconstruction's own blur in pixels: the one that gives the best correlation is taken."""

_FREE = 8
"""Fitted parameters of a projection: all but the radial term."""

_ITERATIONS = 25
_SAMPLES = 150_000
_TUKEY = 4.685 * 1.4826


class Samples(NamedTuple):
    """Points of the displayed pictures at which they are compared with the reconstructions.

    Args:
        points: (G, 2), pixels of the displayed picture.
        values: (N, G), displayed light there.
        weights: (G,), 1 for those that count.
        shape: rows and columns of the grid of points, row by row.
    """

    points: Points
    values: Array
    weights: Array
    shape: Size


class Smooth(NamedTuple):
    """Reconstructions, smoothed and compressed, and their derivatives.

    Args:
        images: (N, H, W).
        right: derivative along the rows.
        down: derivative along the columns.
    """

    images: FloatFrame
    right: FloatFrame
    down: FloatFrame


class Refined(NamedTuple):
    """A projection and the correlation of pictures and reconstructions under it, -1 to 1."""

    projection: Projection
    correlation: float


def refine(projection: Projection, views: Views, *, blurs: tuple[float, ...]) -> Refined:
    """Maximise the correlation, from coarse to fine; the radial term stays.

    Args:
        projection: start, within about 3 times the first blur of the truth.
        views: pictures and reconstructions.
        blurs: standard deviations in pixels of the camera of the Gaussians that smooth both, one after the other.

    References:
        G. D. Evangelidis and E. Z. Psarakis, Parametric image alignment using enhanced correlation coefficient
        maximization, IEEE PAMI 30 (2008).
    """
    result = Refined(projection, -1.0)
    for blur in blurs:
        smooth = smooth_images(views.reconstructions, blur)
        samples = matched_samples(result.projection, views, smooth, blur)
        result = _maximise(result.projection, samples, smooth)
    return result


def correlation_at(projection: Projection, views: Views, *, robust: bool = False) -> float:
    """Correlation of pictures and reconstructions smoothed by `FINE_BLUR`.

    Args:
        projection: from pictures to reconstructions.
        views: pictures and reconstructions.
        robust: with Tukey's weights, as `refine`; they hide a small difference between a picture and its mirror image.
    """
    smooth = smooth_images(views.reconstructions, FINE_BLUR)
    samples = matched_samples(projection, views, smooth, FINE_BLUR)
    motion = np.zeros((len(samples.points), 2, 0))
    return linearise(projection.to_camera(samples.points), motion, samples, smooth, robust=robust).correlation


def matched_samples(projection: Projection, views: Views, smooth: Smooth, blur: float) -> Samples:
    """Samples with the displayed light smoothed like the reconstructions, which are less sharp than the display.

    Args:
        projection: from pictures to reconstructions.
        views: pictures.
        smooth: reconstructions smoothed by ``blur``.
        blur: standard deviation in pixels of the camera.
    """
    trials = [sample(projection, views, float(np.hypot(blur, own)), step=max(1.0, 0.7 * blur)) for own in _OWN_BLURS]
    motion = np.zeros((len(trials[0].points), 2, 0))
    points = projection.to_camera(trials[0].points)
    return max(trials, key=lambda trial: linearise(points, motion, trial, smooth).correlation)


def sample(projection: Projection, views: Views, blur: float, *, step: float) -> Samples:
    """Points about ``step`` pixels of the camera apart, with the displayed light smoothed by ``blur`` of its pixels."""
    import cv2

    height, width = views.picture_size
    sides = _side_lengths(projection)
    step = max(step, np.sqrt(len(views) * sides.prod() / _SAMPLES))
    rows, columns = (max(8, round(length / step)) for length in sides)
    rim_y, rim_x = max(2, round(DARK_RIM * rows)), max(2, round(DARK_RIM * columns))
    values = []
    for picture in views.pictures:
        small = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA)
        framed = cv2.copyMakeBorder(small, rim_y, rim_y, rim_x, rim_x, cv2.BORDER_CONSTANT, value=0)
        values.append(compress(np.asarray(cv2.GaussianBlur(framed, (0, 0), blur / step), np.float32)).ravel())
    y, x = np.mgrid[-rim_y : rows + rim_y, -rim_x : columns + rim_x]
    points = np.stack([(x + 0.5) * width / columns - 0.5, (y + 0.5) * height / rows - 0.5], -1).reshape(-1, 2)
    inside = ((x >= 0) & (x < columns) & (y >= 0) & (y < rows)).ravel()
    seen = _look(views.reconstructions, projection.to_camera(points))
    dark = np.median(seen[:, ~inside]) < 0.25 * seen[:, inside].mean()
    weights = np.where(inside, 1.0, float(dark))
    return Samples(points, np.array(values, np.float64), weights, (rows + 2 * rim_y, columns + 2 * rim_x))


def _side_lengths(projection: Projection) -> Array:
    """Mean height and width of the picture in pixels of the camera."""
    top, right, bottom, left = np.hypot(*side_vectors(projection.corners()).T)
    return np.clip([(left + right) / 2, (top + bottom) / 2], 8, 4096)


def smooth_images(images: FloatFrame, blur: float) -> Smooth:
    """Images (N, H, W) smoothed by a Gaussian of this standard deviation, compressed."""
    import cv2

    smooth = np.stack([compress(np.asarray(cv2.GaussianBlur(image, (0, 0), blur), np.float32)) for image in images])
    return Smooth(smooth, *(np.asarray(np.gradient(smooth, axis=axis), np.float32) for axis in (2, 1)))


def _look(images: FloatFrame, points: Points) -> Array:
    """Images (N, H, W) at points (G, 2), bilinear: (N, G)."""
    import cv2

    x, y = points.astype(np.float32).T
    border = cv2.BORDER_REPLICATE
    looks = [cv2.remap(image, _rows(x), _rows(y), cv2.INTER_LINEAR, borderMode=border) for image in images]
    return np.stack([look.reshape(-1)[: len(x)] for look in looks]).astype(np.float64)


def _rows(values: FloatFrame) -> FloatFrame:
    """Values as rows of 1,024, for OpenCV's limit of 32,767 columns."""
    return np.pad(values, (0, -len(values) % 1024), mode="edge").reshape(-1, 1024)


class Linear(NamedTuple):
    """Equation (1) about a projection, gain and offset eliminated.

    Args:
        residual: (N, G).
        slope: (N, G, K), derivative of the residual.
        weights: (N, G).
        correlation: of pictures and reconstructions.
    """

    residual: Array
    slope: Array
    weights: Array
    correlation: float


def linearise(points: Points, motion: Array, samples: Samples, smooth: Smooth, *, robust: bool = True) -> Linear:
    """Residual and slope of equation (1).

    Args:
        points: (G, 2), pixels of the camera at which the samples appear.
        motion: (G, 2, K), derivative of the points by the parameters.
        samples: of the displayed pictures.
        smooth: reconstructions.
        robust: weight the samples by Tukey's biweight.
    """
    height, width = smooth.images.shape[1:]
    inside = ((points >= 0) & (points <= [width - 1, height - 1])).all(-1)
    weights = np.broadcast_to(samples.weights * inside, samples.values.shape)
    if inside.mean() < 0.25:
        return Linear(samples.values * 0, np.zeros((*samples.values.shape, motion.shape[-1])), weights, -1.0)
    seen, gx, gy = (_look(each, points) for each in smooth)
    if robust:
        weights = weights * _tukey(_project(seen, samples.values, weights), weights)
    slope = gx[..., None] * motion[:, 0] + gy[..., None] * motion[:, 1]
    residual = _project(seen, samples.values, weights)
    total = _project(seen, None, weights)
    unexplained = (weights * residual**2).sum() / max((weights * total**2).sum(), 1e-12)
    sign = np.sign((weights * total * samples.values).sum())
    for k in range(slope.shape[-1]):
        slope[..., k] = _project(slope[..., k], samples.values, weights)
    return Linear(residual, slope, weights, float(sign * np.sqrt(max(0.0, 1 - unexplained))))


def _project(values: Array, template: Array | None, weights: Array) -> Array:
    """Values (N, G) minus the best offset, and the best multiple of the template, of each row."""
    total = np.maximum(weights.sum(1, keepdims=True), 1e-9)
    rest = values - (weights * values).sum(1, keepdims=True) / total
    if template is None:
        return rest
    t = template - (weights * template).sum(1, keepdims=True) / total
    gain = (weights * t * rest).sum(1, keepdims=True) / np.maximum((weights * t * t).sum(1, keepdims=True), 1e-12)
    return rest - gain * t


def _tukey(residual: Array, weights: Array) -> Array:
    """Tukey's biweight of each row's residual."""
    scale = [np.median(np.abs(r[w > 0])) if (w > 0).any() else 1.0 for r, w in zip(residual, weights, strict=True)]
    z = residual / np.maximum(_TUKEY * np.array(scale)[:, None], 1e-9)
    return np.where(np.abs(z) < 1, (1 - z * z) ** 2, 0.0)


def _maximise(projection: Projection, samples: Samples, smooth: Smooth) -> Refined:
    """Levenberg-Marquardt on equation (1) at one blur."""
    damping = 1e-4
    best = linearise(*_placed(projection, samples), samples, smooth)
    for _ in range(_ITERATIONS):
        A = np.einsum("ngi,ng,ngj->ij", best.slope, best.weights, best.slope, optimize=True)
        g = np.einsum("ngi,ng,ng->i", best.slope, best.weights, best.residual, optimize=True)
        step = np.zeros(9)
        step[:_FREE] = -np.linalg.solve(A + damping * np.diag(A.diagonal()) + 1e-12 * np.eye(_FREE), g)
        moved = _moved(projection, step)
        if moved is None:
            damping *= 10
            continue
        trial = linearise(*_placed(moved, samples), samples, smooth)
        motion = np.abs(moved.corners() - projection.corners()).max()
        if trial.correlation >= best.correlation:
            projection, best, damping = moved, trial, damping / 10
        else:
            damping *= 10
        if motion < 0.003 or damping > 1e4:
            break
    return Refined(projection, best.correlation)


def _placed(projection: Projection, samples: Samples) -> tuple[Points, Array]:
    points, motion = projection.project(samples.points)
    return points, motion[..., :_FREE]


def _moved(projection: Projection, step: Array) -> Projection | None:
    """The projection after a step, if the picture is then still a valid quadrilateral (`_is_sound`)."""
    with suppress(AlignmentError, ParameterError):
        moved = projection.moved(step)
        return moved if _is_sound(moved) else None
    return None


def _is_sound(projection: Projection) -> bool:
    """Whether the picture is a convex quadrilateral, not much larger than the frame, in front of the camera."""
    h = np.array(projection.parameters)
    if abs(h[6]) + abs(h[7]) > 0.8 or abs(h[8]) > 0.3:
        return False
    corners = projection.corners()
    sides = side_vectors(corners)
    after = np.roll(sides, -1, 0)
    turns = np.sign(sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0])
    return abs(turns.sum()) == 4 and bool(np.abs(corners).max() < 8 * max(projection.camera_size))
