"""Warp displayed pictures to the camera's frame, in linear light."""

import numpy as np
import torch
from torch import Tensor

from mwdn.arguments import check_batch
from mwdn.errors import ShapeError
from mwdn.registration.projection import Points, Projection, side_vectors
from mwdn.types import FloatFrame, Image, Scene

_SAMPLES = 3
"""Points along each side of a pixel of the camera whose light is averaged."""

_ROWS = 64
"""Rows of the camera's frame that are warped at a time: the map of 64 rows of 1,920 pixels takes 8 MB."""


def warp_pictures(pictures: Scene, projection: Projection) -> Image:
    """The ground truth of captures: displayed pictures as the camera sees them, dark beside the display.

    Each pixel of the camera is the mean of the light within it.

    Args:
        pictures: (B, C, h, w), linear light.
        projection: from the pictures' pixels to the camera's.

    Returns:
        (B, C, H, W), the camera's size.

    Raises:
        ParameterError: the pictures are no tensor of floats.
        ShapeError: they are no batch, or have another size than the projection's.
    """
    check_batch(pictures, "pictures")
    if tuple(pictures.shape[-2:]) != tuple(projection.picture_size):
        (h, w), (H, W) = pictures.shape[-2:], projection.picture_size
        raise ShapeError(f"`pictures` ({h} x {w}) must have the projection's size ({H} x {W}): `for_picture`.")
    return torch.stack([_warp(picture, projection) for picture in pictures])


def _warp(picture: Tensor, projection: Projection) -> Tensor:
    height, width = projection.camera_size
    frame, projection = _downsampled(picture.movedim(0, -1).float().cpu().numpy(), projection)
    warped = np.empty((height, width, frame.shape[-1]), np.float32)
    for top in range(0, height, _ROWS):
        rows = min(_ROWS, height - top)
        y, x = np.mgrid[: rows * _SAMPLES, : width * _SAMPLES]
        points = (np.stack([x, y], -1) + 0.5) / _SAMPLES - 0.5 + [0, top]
        fine = _sample(frame, projection.to_picture(points))
        warped[top : top + rows] = fine.reshape(rows, _SAMPLES, width, _SAMPLES, -1).mean((1, 3))
    return torch.from_numpy(warped).movedim(-1, 0)


def _sample(frame: FloatFrame, points: Points) -> FloatFrame:
    """Bilinear samples (rows, columns, C); the border is a sharp edge half a pixel beyond the outer pixels."""
    import cv2

    height, width = frame.shape[:2]
    inside = np.asarray((points > -0.5).all(-1) & (points < [width - 0.5, height - 0.5]).all(-1))
    x, y = np.moveaxis(np.where(inside[..., None], points, 0), -1, 0).astype(np.float32)
    looked = cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(looked, np.float32).reshape(*x.shape, -1) * inside[..., None]


def _downsampled(frame: FloatFrame, projection: Projection) -> tuple[FloatFrame, Projection]:
    """The picture with about as many pixels as there are samples, so that none is skipped."""
    import cv2

    h, w = projection.picture_size
    top, right, bottom, left = np.hypot(*side_vectors(projection.corners()).T)
    wanted = _SAMPLES * max(left, right), _SAMPLES * max(top, bottom)
    size = max(2, min(h, round(wanted[0]))), max(2, min(w, round(wanted[1])))
    if size == (h, w):
        return np.ascontiguousarray(frame), projection
    small = cv2.resize(frame, size[::-1], interpolation=cv2.INTER_AREA)
    moved = Projection(projection.parameters, size, projection.camera_size)  # normalised coordinates stay
    return np.asarray(small, np.float32).reshape(*size, -1), moved
