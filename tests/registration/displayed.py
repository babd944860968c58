"""Pictures on a display, and what a camera sees of them: without the code that is tested."""

from functools import cache

import cv2
import numpy as np
import torch

from mwdn.registration import Projection


def placed(picture_size, camera_size, *, turn=-4.0, fill=0.5, mirrored=False, radial=0.0, seed=0):
    """The true projection: a picture in the middle of the frame, turned, in perspective."""
    generator = np.random.default_rng(seed)
    (h, w), (H, W) = picture_size, camera_size
    corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], float)
    seen = (corners - corners.mean(0)) * fill * W / w * [-1 if mirrored else 1, 1]
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    seen = seen @ np.array([[c, s], [-s, c]]) * (1 + 0.03 * generator.standard_normal((4, 1)))
    seen += [W / 2 + 3.3, H / 2 - 2.1]
    matrix = cv2.getPerspectiveTransform(corners.astype(np.float32), seen.astype(np.float32))
    return Projection.from_homography(matrix.astype(float), picture_size, camera_size, radial)


def seen_from(picture, homography, camera_size, *, radial=0.0, samples=6):
    """Light (1, C, H, W) of a picture (h, w, C) in the camera's frame: 36 points a pixel, looked up bilinearly."""
    H, W = camera_size
    y, x = (np.mgrid[: H * samples, : W * samples] + 0.5) / samples - 0.5
    centre, scale = np.array([(W - 1) / 2, (H - 1) / 2]), np.hypot(W, H) / 2
    m = (np.stack([x, y], -1) - centre) / scale
    q = m
    for _ in range(30 if radial else 0):
        q = m / (1 + radial * (q**2).sum(-1, keepdims=True))
    points = cv2.perspectiveTransform((q * scale + centre).reshape(-1, 1, 2), np.linalg.inv(homography))
    px, py = points.reshape(H * samples, W * samples, 2).astype(np.float32).transpose(2, 0, 1)
    fine = cv2.remap(picture, px, py, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    light = fine.reshape(H, samples, W, samples, -1).mean((1, 3))
    return torch.from_numpy(light).float().movedim(-1, 0)[None]


def mean_error(estimate, truth):
    """Mean distance in pixels of the camera over the picture's area."""
    height, width = truth.picture_size
    y, x = np.mgrid[0 : height - 1 : 21j, 0 : width - 1 : 21j]
    points = np.stack([x, y], -1)
    return float(np.linalg.norm(estimate.to_camera(points) - truth.to_camera(points), axis=-1).mean())


@cache
def natural_picture(name, size):
    """A photograph (size, size, 3) in linear light."""
    from skimage import data, transform

    whole = getattr(data, name)()
    side = min(whole.shape[:2])
    square = transform.resize(whole[:side, :side], (size, size), anti_aliasing=True)
    return (square**2.2).astype(np.float32)


def natural_pictures(count, size):
    """So many of four photographs."""
    return [natural_picture(name, size) for name in ("astronaut", "coffee", "chelsea", "rocket")[:count]]


def board(side=420):
    """A ChArUco board (side, side, 3)."""
    from cv2 import aruco

    dictionary = aruco.getPredefinedDictionary(aruco.DICT_4X4_50)
    picture = aruco.CharucoBoard((5, 5), 1.0, 0.75, dictionary).generateImage((side, side))
    return np.repeat(picture[..., None] / np.float32(255), 3, -1)


def dots(side=420, count=7):
    """White dots on black (side, side, 3); two of the first row are larger, so that no turn or mirroring fits."""
    picture = np.zeros((side, side), np.float32)
    step = side / count
    for number in range(count**2):
        centre = round(step * (number % count + 0.5)), round(step * (number // count + 0.5))
        cv2.circle(picture, centre, round(step * (0.25 if number in (0, 1) else 0.14)), 1.0, -1, cv2.LINE_AA)
    return np.repeat(picture[..., None], 3, -1)
