"""Fit a projection to points: robust against outliers, with a radial term only where the points show one."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mwdn.errors import AlignmentError
from mwdn.registration.projection import Points, Projection
from mwdn.types import Size

_ITERATIONS = 20
_STRONG = 10.0
"""Difference of the Bayesian information criterion that is strong evidence (Kass and Raftery, 1995)."""


class PointFit(NamedTuple):
    """A projection and how well it fits.

    Args:
        projection: fitted to the inliers.
        residuals: (N, 2), seen minus fitted position of every point, in pixels of the camera.
        inliers: (N,), points within the tolerance.
    """

    projection: Projection
    residuals: Points
    inliers: npt.NDArray[np.bool_]

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the inliers in pixels."""
        return float(np.sqrt((self.residuals[self.inliers] ** 2).sum(-1).mean()))


def fit_points(
    picture: Points, camera: Points, *, picture_size: Size, camera_size: Size, tolerance_px: float = 3.0
) -> PointFit:
    """Fit a projection to points of the displayed picture and where the camera sees them.

    Args:
        picture: (N, 2), in pixels of the displayed picture; at least 4.
        camera: (N, 2), in pixels of the reconstruction.
        picture_size: height and width of the displayed picture.
        camera_size: height and width of the reconstruction.
        tolerance_px: points farther from the fit are outliers.

    Raises:
        AlignmentError: fewer than 4 points, or no projection fits 4 of them.

    References:
        D. Barath et al., MAGSAC++, a fast, reliable and accurate robust estimator, CVPR (2020).
    """
    count = len(picture)
    if count < 4:
        raise AlignmentError(f"A homography needs 4 points; {count} were found. Show a picture with more detail.")
    matrix, found = _consensus(picture, camera, tolerance_px)
    if matrix is None or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise AlignmentError(f"No homography fits the {count} points. Three of them may lie on a line.")
    inliers = found.ravel() > 0 if count > 4 else np.ones(count, bool)
    if inliers.sum() < 4:
        raise AlignmentError(f"No homography fits 4 of the {count} points within {tolerance_px:g} px.")
    start = Projection.from_homography(matrix, picture_size, camera_size)
    flat = _descend(start, picture[inliers], camera[inliers], radial=False)
    bent = _descend(flat, picture[inliers], camera[inliers], radial=True)
    best = bent if _evidence(flat, bent, picture[inliers], camera[inliers]) > _STRONG else flat
    residuals = camera - best.to_camera(picture)
    inliers = np.hypot(*residuals.T) <= tolerance_px
    if inliers.sum() < 4:
        raise AlignmentError(f"No homography fits 4 of the {count} points within {tolerance_px:g} px.")
    return PointFit(best, residuals, inliers)


def _consensus(picture: Points, camera: Points, tolerance_px: float) -> tuple[Points | None, npt.NDArray[np.uint8]]:
    """Homography that most points agree with, and which they are."""
    import cv2

    best: tuple[Points | None, npt.NDArray[np.uint8]] = None, np.zeros((len(picture), 1), np.uint8)
    for flip in (np.eye(3), np.diag([-1.0, 1.0, 1.0])):  # USAC refuses homographies that mirror
        points = picture @ flip[:2, :2]
        method = cv2.USAC_MAGSAC if len(picture) > 4 else 0
        matrix, found = cv2.findHomography(points, camera, method, tolerance_px, maxIters=5000, confidence=0.9999)
        if matrix is not None and (best[0] is None or found.sum() > best[1].sum()):
            best = matrix @ flip, found.astype(np.uint8)
    return best


def _descend(projection: Projection, picture: Points, camera: Points, *, radial: bool) -> Projection:
    """Least squares by Gauss-Newton."""
    free = 9 if radial else 8
    for _ in range(_ITERATIONS if len(picture) > 4 else 0):  # a homography through four points is exact
        seen, slope = projection.project(picture)
        step = np.zeros(9)
        step[:free] = np.linalg.lstsq(slope[..., :free].reshape(-1, free), (camera - seen).ravel(), rcond=None)[0]
        projection = projection.moved(step)
        if np.abs(step).max() < 1e-10:
            break
    return projection


def _evidence(flat: Projection, bent: Projection, picture: Points, camera: Points) -> float:
    """Bayesian information criterion for the radial term: ``n ln(RSS0 / RSS1) - ln n``, n coordinates."""
    n = camera.size
    if n < 24 or abs(bent.radial) > 0.3:  # twelve points: fewer cannot tell distortion from their errors
        return -np.inf
    rss = [max(((camera - each.to_camera(picture)) ** 2).sum(), 1e-12) for each in (flat, bent)]
    return float(n * np.log(rss[0] / rss[1]) - np.log(n))
