"""A projection from features (SIFT) of displayed pictures and reconstructions, pooled over many pictures."""

from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from mwdn.errors import AlignmentError
from mwdn.registration.point_fit import fit_points
from mwdn.registration.projection import Points, Projection
from mwdn.registration.views import Bytes, Views

_RATIO = 0.8
"""Lowe's ratio of the nearest and the second nearest feature: above it a match is ambiguous."""

_FEWEST = 10
_ENLARGED = 400
"""Pictures below this many pixels a side are enlarged: SIFT finds few features of less than 4 pixels."""

_MAX_VIEWS = 40


def match_features(views: Views) -> list[Projection]:
    """Projections that at least ten matched features support, of the picture or its mirror image, best first.

    References:
        D. G. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 60 (2004).
    """
    fits = []
    pictures, reconstructions = views.bytes
    for mirrored in (False, True):
        turned = [picture[:, ::-1] if mirrored else picture for picture in pictures[:_MAX_VIEWS]]
        pairs = [_matches(picture, seen) for picture, seen in zip(turned, reconstructions, strict=False)]
        displayed, seen = (np.concatenate(part) for part in zip(*pairs, strict=True))
        if mirrored and len(displayed):
            displayed[:, 0] = views.picture_size[1] - 1 - displayed[:, 0]
        with suppress(AlignmentError):
            fit = fit_points(displayed, seen, picture_size=views.picture_size, camera_size=views.camera_size)
            if fit.inliers.sum() >= _FEWEST:
                fits.append((int(fit.inliers.sum()), fit.projection))
    return [projection for _, projection in sorted(fits, key=lambda each: -each[0])]


def _matches(picture: Bytes, seen: Bytes) -> tuple[Points, Points]:
    """Positions of features that match, in pixels of both."""
    import cv2

    sift = cv2.SIFT_create(contrastThreshold=0.02)  # type: ignore[attr-defined]
    displayed, first = _describe(sift, picture)
    camera, second = _describe(sift, seen)
    if min(len(displayed), len(camera)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    good = [one for one, other in nearest if one.distance < _RATIO * other.distance]
    return displayed[[match.queryIdx for match in good]], camera[[match.trainIdx for match in good]]


def _describe(sift: Any, image: Bytes) -> tuple[Points, npt.NDArray[np.float32]]:  # noqa: ANN401
    """Positions (K, 2) in pixels of the image, and descriptors."""
    import cv2

    factor = max(1, round(_ENLARGED / max(image.shape)))
    large = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    keypoints, descriptors = sift.detectAndCompute(np.ascontiguousarray(large), None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    points = np.array([keypoint.pt for keypoint in keypoints], np.float64)
    return (points + 0.5) / factor - 0.5, descriptors
