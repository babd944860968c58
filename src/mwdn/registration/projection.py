"""The map from a displayed picture to the camera's frame: a homography, and a radial term.

A flat display seen through a thin mask is a projective image of the picture. Refraction at the mask's and the sensor's
glass adds a displacement that grows with the cube of the distance from the axis. In normalised coordinates, p of the
picture (-1 to 1 along each side) and m of the camera (0 in the middle of the frame, 1 at its corners):

1. ``q = (h0 x + h1 y + h2, h3 x + h4 y + h5) / (h6 x + h7 y + 1)``, with p = (x, y)
2. ``m = q (1 + k |q|^2)``

Points are (x, y): columns to the right, rows down; the centre of the first pixel is (0, 0).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from mwdn.errors import AlignmentError, ParameterError, ShapeError
from mwdn.types import Size

Points = npt.NDArray[np.float64]
"""(..., 2): x to the right, y down, in pixels or normalised."""

_UNDISTORTIONS = 20


@dataclass(frozen=True)
class Projection:
    """From the pixels of a displayed picture to those of the camera.

    Args:
        parameters: h0 to h7 and k of equations (1) and (2).
        picture_size: height and width of the displayed picture in pixels.
        camera_size: height and width of a reconstruction in pixels.

    Raises:
        ParameterError: the parameters are not nine finite numbers.
        AlignmentError: they map the picture onto a line.
    """

    parameters: tuple[float, ...]
    picture_size: Size
    camera_size: Size

    def __post_init__(self) -> None:
        if len(self.parameters) != 9 or not np.isfinite(self.parameters).all():
            raise ParameterError(f"`parameters` ({self.parameters}) must be nine finite numbers.")
        if min(*self.picture_size, *self.camera_size) < 2:
            raise ParameterError(
                f"`picture_size` {self.picture_size} and `camera_size` {self.camera_size} must be at least 2 x 2."
            )
        if abs(np.linalg.det(self._matrix)) < 1e-9:
            raise AlignmentError("`parameters` map the whole picture onto a line. Pick other points.")

    @classmethod
    def from_homography(
        cls, homography: npt.NDArray[np.float64], picture_size: Size, camera_size: Size, radial: float = 0.0
    ) -> "Projection":
        """From a 3 x 3 matrix between pixels of the picture and pixels of the camera, as OpenCV has it.

        Raises:
            AlignmentError: the matrix is singular, or sends the picture's middle to infinity.
        """
        matrix = np.linalg.inv(_to_pixels(*_camera_frame(camera_size))) @ homography
        matrix = matrix @ _to_pixels(*_picture_frame(picture_size))
        if not np.isfinite(matrix).all() or abs(matrix[2, 2]) < 1e-12:
            raise AlignmentError("The homography is singular, or sends the middle of the picture to infinity.")
        return cls((*map(float, (matrix / matrix[2, 2]).flat[:8]), radial), picture_size, camera_size)

    @property
    def radial(self) -> float:
        """The k of equation (2): relative displacement at the corners of the camera's frame."""
        return self.parameters[8]

    @property
    def homography(self) -> npt.NDArray[np.float64]:
        """Equation (1) as a 3 x 3 matrix between pixels; without the radial term."""
        picture, camera = _picture_frame(self.picture_size), _camera_frame(self.camera_size)
        matrix = _to_pixels(*camera) @ self._matrix @ np.linalg.inv(_to_pixels(*picture))
        return matrix / matrix[2, 2]

    @cached_property
    def _matrix(self) -> npt.NDArray[np.float64]:
        return np.array([*self.parameters[:8], 1.0]).reshape(3, 3)

    def to_camera(self, points: Points) -> Points:
        """Pixels of the camera (..., 2) at which pixels of the picture (..., 2) appear."""
        return self.project(points)[0]

    def project(self, points: Points) -> tuple[Points, npt.NDArray[np.float64]]:
        """As `to_camera`, with the derivative by the parameters, (..., 2, 9), in pixels of the camera."""
        middle, half = _picture_frame(self.picture_size)
        p = (points - middle) / half
        x, y = p[..., 0], p[..., 1]
        h = self._matrix
        W = h[2, 0] * x + h[2, 1] * y + 1
        u, v = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / W, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / W
        zero, one = np.zeros_like(x), np.ones_like(x)
        du = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], -1) / W[..., None]
        dv = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], -1) / W[..., None]
        q, dq = np.stack([u, v], -1), np.stack([du, dv], -2)
        k, r2 = self.radial, u * u + v * v
        dm_dq = (1 + k * r2)[..., None, None] * np.eye(2) + 2 * k * q[..., :, None] * q[..., None, :]
        slope = np.concatenate([dm_dq @ dq, (q * r2[..., None])[..., None]], -1)
        centre, scale = _camera_frame(self.camera_size)
        return q * (1 + k * r2)[..., None] * scale + centre, slope * scale

    def to_picture(self, points: Points) -> Points:
        """Pixels of the picture (..., 2) that appear at pixels of the camera (..., 2); the inverse of `to_camera`."""
        centre, scale = _camera_frame(self.camera_size)
        m = (points - centre) / scale
        q = m
        for _ in range(_UNDISTORTIONS if self.radial else 0):  # converges for |k| < 1/3 within the frame
            q = m / (1 + self.radial * (q * q).sum(-1, keepdims=True))
        homogeneous = np.concatenate([q, np.ones_like(q[..., :1])], -1) @ np.linalg.inv(self._matrix).T
        middle, half = _picture_frame(self.picture_size)
        with np.errstate(divide="ignore", invalid="ignore"):
            return homogeneous[..., :2] / homogeneous[..., 2:] * half + middle

    def moved(self, step: npt.NDArray[np.float64]) -> "Projection":
        """With a step (9,) added to the parameters."""
        return replace(self, parameters=tuple(map(float, np.add(self.parameters, step))))

    def for_picture(self, size: Size) -> "Projection":
        """The projection of a picture of another resolution that covers the same part of the display.

        Raises:
            ParameterError: the picture has other proportions.
        """
        (h, w), (H, W) = size, self.picture_size
        if abs(h * W - w * H) > max(W, H):  # a pixel of rounding
            raise ParameterError(
                f"The picture ({h} x {w}) must have the proportions of the one that was aligned ({H} x {W}). "
                "Align again with pictures of this size."
            )
        return replace(self, picture_size=size)

    def check_camera(self, size: Size) -> None:
        """Raise a `ShapeError` unless the camera's frames have this size."""
        if tuple(size) != tuple(self.camera_size):
            (h, w), (H, W) = size, self.camera_size
            raise ShapeError(
                f"The measurements ({h} x {w}) must have the size that was aligned ({H} x {W}). Use the same crop and "
                "bin, or align again without `--homography`."
            )

    def corners(self) -> Points:
        """Pixels of the camera (4, 2) of the picture's outer corners, clockwise from its own top left."""
        return self.to_camera(picture_corners(self.picture_size))

    @property
    def outside(self) -> float:
        """Share of the picture outside of the camera's frame, 0 to 1."""
        (h, w), (H, W) = self.picture_size, self.camera_size
        y, x = np.meshgrid(np.linspace(0, h - 1, 64), np.linspace(0, w - 1, 64), indexing="ij")
        u, v = np.moveaxis(self.to_camera(np.stack([x, y], -1)), -1, 0)
        inside = (u > -0.5) & (u < W - 0.5) & (v > -0.5) & (v < H - 0.5)
        return 1 - float(inside.mean())

    def to_dict(self) -> dict[str, Any]:
        """Numbers for JSON; `from_dict` reads them."""
        return {
            "homography": self.homography.tolist(),
            "radial": self.radial,
            "picture_size": list(self.picture_size),
            "camera_size": list(self.camera_size),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Projection":
        """From the numbers of `to_dict`.

        Raises:
            AlignmentError: the matrix is singular.
            KeyError, TypeError, ValueError: the content is something else.
        """
        matrix = np.array(content["homography"], np.float64).reshape(3, 3)
        (h, w), (H, W) = content["picture_size"], content["camera_size"]
        return cls.from_homography(matrix, (int(h), int(w)), (int(H), int(W)), float(content["radial"]))


def picture_corners(size: Size) -> Points:
    """Outer corners (4, 2) of a picture: half a pixel beyond the centres of its corner pixels."""
    height, width = size
    right, bottom = width - 0.5, height - 0.5
    return np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])


def side_vectors(corners: Points) -> Points:
    """Vectors (4, 2) from corner to corner along the top, right, bottom and left side."""
    return np.roll(corners, -1, 0) - corners


def _picture_frame(size: Size) -> tuple[Points, Points]:
    """Middle and half width and height in pixels."""
    height, width = size
    return np.array([(width - 1) / 2, (height - 1) / 2]), np.array([width / 2, height / 2])


def _camera_frame(size: Size) -> tuple[Points, float]:
    """Middle and half diagonal in pixels."""
    height, width = size
    return np.array([(width - 1) / 2, (height - 1) / 2]), float(np.hypot(width, height) / 2)


def _to_pixels(middle: Points, scale: Points | float) -> npt.NDArray[np.float64]:
    """Matrix from normalised coordinates to pixels."""
    sx, sy = np.broadcast_to(scale, 2)
    return np.array([[sx, 0, middle[0]], [0, sy, middle[1]], [0, 0, 1.0]])
