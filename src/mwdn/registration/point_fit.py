"""Fit a projection to points: robust against outliers, with a radial term only where it predicts other points."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mwdn.errors import AlignmentError
from mwdn.registration.projection import Points, Projection
from mwdn.types import Size

TOLERANCE_PX = 3.0
"""Points of the camera farther from the fit than this are outliers."""

_ITERATIONS = 20
_STRONG = 10.0
"""Difference of the Bayesian information criterion that is strong evidence (Kass and Raftery, 1995)."""

_MAX_RADIAL = 0.3
"""Largest radial term: `Projection.to_picture` converges below 1/3."""

_MIN_PX = 0.03
"""Error of a part that its standard error does not include."""

_PREDICTS = 0.8
"""A radial term must reduce the error at points that were left out to this part. Errors of neighbours are alike in
reconstructions, but the criterion assumes that they are independent."""


class PointFit(NamedTuple):
    """A projection and how well it fits.

    Args:
        projection: fitted to the inliers.
        inliers: (N,), points within the tolerance.
    """

    projection: Projection
    inliers: npt.NDArray[np.bool_]


class _Seen(NamedTuple):
    """Points of the picture, where the camera sees them, and the weights of their errors."""

    picture: Points
    camera: Points
    weights: npt.NDArray[np.float64]

    @classmethod
    def of(cls, picture: Points, camera: Points, errors: npt.NDArray[np.float64] | None) -> "_Seen":
        return cls(picture, camera, np.ones(len(picture)) if errors is None else 1 / np.hypot(errors, _MIN_PX))

    def part(self, chosen: npt.NDArray[np.bool_]) -> "_Seen":
        return _Seen(self.picture[chosen], self.camera[chosen], self.weights[chosen])

    def error(self, projection: Projection) -> float:
        """Sum of the squared weighted distances from a projection."""
        distances = (self.camera - projection.to_camera(self.picture)) * self.weights[:, None]
        return float(np.square(distances).sum())


def fit_points(
    picture: Points,
    camera: Points,
    *,
    picture_size: Size,
    camera_size: Size,
    errors: npt.NDArray[np.float64] | None = None,
) -> PointFit:
    """Fit a homography to points of the displayed picture and where the camera sees them.

    Args:
        picture: (N, 2), in pixels of the displayed picture; at least 4.
        camera: (N, 2), in pixels of the reconstruction.
        picture_size: height and width of the displayed picture.
        camera_size: height and width of the reconstruction.
        errors: (N,), standard errors of the points in the reconstruction; equal unless given.

    Raises:
        AlignmentError: fewer than 4 points, or no homography fits 4 of them.

    References:
        D. Barath et al., MAGSAC++, a fast, reliable and accurate robust estimator, CVPR (2020).
    """
    count = len(picture)
    if count < 4:
        raise AlignmentError(f"A homography needs 4 points; {count} were found. Show a picture with more detail.")
    matrix, inlier_mask = _consensus(picture, camera)
    if matrix is None or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise AlignmentError(f"No homography fits the {count} points. Three of them may lie on a line.")
    inliers = inlier_mask.ravel() > 0 if count > 4 else np.ones(count, bool)
    _check_inliers(inliers)
    start = Projection.from_homography(matrix, picture_size, camera_size)
    best = _descend(start, _Seen.of(picture, camera, errors).part(inliers), radial=False)
    inliers = np.hypot(*(camera - best.to_camera(picture)).T) <= TOLERANCE_PX
    _check_inliers(inliers)
    return PointFit(best, inliers)


def _check_inliers(inliers: npt.NDArray[np.bool_]) -> None:
    if inliers.sum() < 4:
        raise AlignmentError(f"No homography fits 4 of the {len(inliers)} points within {TOLERANCE_PX:g} px.")


def correct(
    projection: Projection, picture: Points, camera: Points, *, errors: npt.NDArray[np.float64] | None = None
) -> Projection:
    """Correct a projection by points, where there is strong evidence that it is off (Bayesian information criterion).

    A radial term is fitted if there is strong evidence for it, too, and if it predicts rows and columns of points that
    are left out better.

    Args:
        projection: that was found in another way.
        picture: (N, 2), in pixels of the displayed picture; at least 12.
        camera: (N, 2), in pixels of the reconstruction.
        errors: (N,), standard errors of the points in the reconstruction; equal unless given.

    Raises:
        AlignmentError: no homography fits the points.
    """
    sizes = projection.picture_size, projection.camera_size
    fit = fit_points(picture, camera, picture_size=sizes[0], camera_size=sizes[1], errors=errors)
    seen = _Seen.of(picture, camera, errors).part(fit.inliers)
    best = _bent(fit.projection, seen)
    return best if _evidence(projection, best, seen, 9 if best.radial else 8) > _STRONG else projection


def _consensus(picture: Points, camera: Points) -> tuple[Points | None, npt.NDArray[np.uint8]]:
    """Homography that most points agree with, and which they are."""
    import cv2

    best: tuple[Points | None, npt.NDArray[np.uint8]] = None, np.zeros((len(picture), 1), np.uint8)
    for flip in (np.eye(3), np.diag([-1.0, 1.0, 1.0])):  # USAC refuses homographies that mirror
        points = picture @ flip[:2, :2]
        method = cv2.USAC_MAGSAC if len(picture) > 4 else 0
        matrix, inlier_mask = cv2.findHomography(points, camera, method, TOLERANCE_PX, maxIters=5000, confidence=0.9999)
        if matrix is not None and (best[0] is None or inlier_mask.sum() > best[1].sum()):
            best = matrix @ flip, inlier_mask.astype(np.uint8)
    return best


def _descend(projection: Projection, seen: _Seen, *, radial: bool) -> Projection:
    """Weighted least squares by Gauss-Newton."""
    free = 9 if radial else 8
    for _ in range(_ITERATIONS if len(seen.picture) > 4 else 0):  # a homography through four points is exact
        fitted, slope = projection.project(seen.picture)
        A = (slope[..., :free] * seen.weights[:, None, None]).reshape(-1, free)
        step = np.zeros(9)
        step[:free] = np.linalg.lstsq(A, ((seen.camera - fitted) * seen.weights[:, None]).ravel(), rcond=None)[0]
        projection = projection.moved(step)
        if np.abs(step).max() < 1e-10:
            break
    return projection


def _bent(flat: Projection, seen: _Seen) -> Projection:
    """The fit with a radial term if the points show one, otherwise the one without."""
    bent = _descend(flat, seen, radial=True)
    is_shown = abs(bent.radial) < _MAX_RADIAL and _evidence(flat, bent, seen, 1) > _STRONG
    return bent if is_shown and _prediction(flat, seen) < _PREDICTS else flat


def _evidence(before: Projection, after: Projection, seen: _Seen, free: int) -> float:
    """Bayesian information criterion for more parameters: ``n ln(RSS0 / RSS1) - free ln n``, n coordinates."""
    n = seen.camera.size
    if n < 24:  # twelve points: fewer cannot tell distortion from their errors
        return -np.inf
    rss = [max(seen.error(each), 1e-12) for each in (before, after)]
    return float(n * np.log(rss[0] / rss[1]) - free * np.log(n))


def _prediction(flat: Projection, seen: _Seen) -> float:
    """Error at left-out points of a fit with a radial term, over that of a fit without.

    Each row and each column of points is left out in turn.
    """
    errors = np.zeros(2)
    count = int(np.clip(np.sqrt(len(seen.picture)), 3, 6))
    for axis in (0, 1):
        places = seen.picture[:, axis].argsort().argsort() * count // len(seen.picture)
        for place in range(count):
            others, left = seen.part(places != place), seen.part(places == place)
            errors += [left.error(_descend(flat, others, radial=radial)) for radial in (False, True)]
    return float(errors[1] / max(errors[0], 1e-12))
