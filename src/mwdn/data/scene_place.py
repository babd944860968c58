"""Where the scenes of a data set are in the frame of its captures."""

from collections.abc import Callable

import numpy as np
import torch

from mwdn.calibration.frame_operations import bin_pixels
from mwdn.errors import ImageError
from mwdn.types import Frame, Size

Place = Callable[[Size, Size], Size | None]
"""From the sizes of a scene and of the frame to the scene's first row and column; ``None`` if they are not known."""


def paper_display(scene: Size, frame: Size) -> Size | None:
    """The MWDN authors' display: 137 x 137 of 320 x 320 pixels, with 94 above and on the left.

    Their public code (`h5_datamake.py`) pads both axes by 94 in front and 89 behind.
    """
    return (94, 94) if (scene, frame) == ((137, 137), (320, 320)) else None


def centre(scene: Size, frame: Size) -> Size:
    """The middle of the frame, for PhlatCam, whose authors do not publish the place."""
    return (frame[0] - scene[0]) // 2, (frame[1] - scene[1]) // 2


def place_scene(scene: Frame, frame: Size, place: Size, name: str) -> Frame:
    """Put a scene (h, w, C) in a dark frame (H, W, C), with its first row and column at ``place``.

    Raises:
        ImageError: it would not lie within the frame.
    """
    (height, width), (top, left) = scene.shape[:2], place
    if min(place) < 0 or top + height > frame[0] or left + width > frame[1]:
        raise ImageError(
            f"The scene of `{name}` ({height} x {width}), placed at {top}, {left}, must lie within the capture "
            f"({frame[0]} x {frame[1]}, before `--bin`). Choose another `--scene-place TOP LEFT`, or a `--scene-size`."
        )
    placed = np.zeros((*frame, scene.shape[2]), scene.dtype)
    placed[top : top + height, left : left + width] = scene
    return placed


def bin_scene(scene: Frame, bin: int) -> Frame:
    """Average blocks of pixels, as in the captures: float32 in [0, 1] for integers; unchanged for a bin of 1."""
    if bin == 1:
        return scene
    peak = np.float32(np.iinfo(scene.dtype).max if scene.dtype.kind == "u" else 1)
    light = torch.from_numpy(scene.astype(np.float32) / peak).movedim(-1, 0)[None]
    return bin_pixels(light, bin)[0].movedim(0, -1).numpy()


def resize_scene(scene: Frame, size: Size) -> Frame:
    """A scene (h, w, C) resampled to another height and width: by areas if it shrinks, else bilinear."""
    import cv2

    if scene.shape[:2] == size:
        return scene
    smaller = scene.shape[0] >= size[0] and scene.shape[1] >= size[1]
    resized = cv2.resize(scene, size[::-1], interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return np.asarray(resized).reshape(*size, -1)
