"""Residuals of a projection, in pixels: the displacement of each part of the picture that fits best."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mwdn.registration.correlation import FINE_BLUR, Samples, Smooth, linearise, matched_samples, smooth_images
from mwdn.registration.projection import Points, Projection
from mwdn.registration.views import Views

_MAX_PARTS, _MIN_PARTS, _PART_PX = 6, 3, 14
"""The picture is divided into rows and columns of parts of this many pixels of the camera at least, each with a
displacement of its own."""

_CORRELATED = 20.0
"""Pixels of a reconstruction that count as one independent sample."""

_UNCERTAIN_PX = 0.5
"""Standard error above which a part, such as a clear sky, gives no displacement."""


class Residuals(NamedTuple):
    """Displacements of parts of the picture, those that are certain.

    Args:
        points: (K, 2), middles of the parts in pixels of the displayed picture.
        seen: (K, 2), where the projection puts them, in pixels of the camera.
        displacements: (K, 2), from there to where the reconstruction shows them.
        errors: (K,), standard errors of the displacements.
    """

    points: Points
    seen: Points
    displacements: Points
    errors: npt.NDArray[np.float64]

    @property
    def rms_px(self) -> float:
        """Root mean square length of the displacements; NaN without parts."""
        return float(np.sqrt((self.displacements**2).sum(-1).mean())) if len(self.points) else float("nan")


def measure_residuals(projection: Projection, views: Views) -> Residuals:
    """Displacement of each part: equation (1) of `mwdn.registration.correlation`, with a translation as parameters.

    Each part has its own gain and offset, so shading does not displace it. The picture's border is not compared: where
    light ends, a blur that is not quite that of the reconstruction looks like a displacement.
    """
    images = smooth_images(views.reconstructions, FINE_BLUR)
    samples = matched_samples(projection, views, images, FINE_BLUR)
    points = projection.to_camera(samples.points)
    count = int(np.clip(min(samples.shape) // _PART_PX, _MIN_PARTS, _MAX_PARTS))
    height, width = views.picture_size
    columns, rows = np.floor((samples.points + 0.5) / [width, height] * count).astype(int).T
    parts = np.where((np.minimum(rows, columns) >= 0) & (np.maximum(rows, columns) < count), rows * count + columns, -1)
    measured = []
    for part in range(count**2):
        inside = parts == part
        own = Samples(samples.points[inside], samples.values[:, inside], samples.weights[inside], samples.shape)
        shift, error = _translation(points[inside], own, images)
        if error < _UNCERTAIN_PX:
            measured.append((own.points.mean(0), points[inside].mean(0), shift, error))
    if not measured:
        return Residuals(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    return Residuals(*(np.array(column) for column in zip(*measured, strict=True)))


def _translation(points: Points, samples: Samples, images: Smooth) -> tuple[Points, float]:
    """Displacement (2,) of samples that appear at points (G, 2), and its standard error; infinite if not certain."""
    motion = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    shift, error = np.zeros(2), np.inf
    for _ in range(3):
        fit = linearise(points + shift, motion, samples, images)
        A = np.einsum("ngi,ng,ngj->ij", fit.slope, fit.weights, fit.slope)
        g = np.einsum("ngi,ng,ng->i", fit.slope, fit.weights, fit.residual)
        count = (fit.weights > 0).sum()
        if count < 30 or np.linalg.cond(A) > 1e6:
            return shift, np.inf
        shift = shift - np.linalg.solve(A, g)
        variance = _CORRELATED * (fit.weights * fit.residual**2).sum() / fit.weights.sum()
        error = float(np.sqrt(np.trace(np.linalg.inv(A)) * variance))
        if np.abs(shift).max() > 4:
            return shift, np.inf
    return shift, error
