"""Find a displayed picture in a reconstruction by correlation at every place, size, turn and mirroring."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.registration.projection import Projection
from mwdn.registration.views import Views, compress
from mwdn.types import FloatFrame, Size

_SIDE = 64
"""Longer side of the frames that are searched: a picture of 12 % of the frame keeps 8 pixels."""

_SCALES = 0.12 * 1.15 ** np.arange(18)
"""Width of the picture relative to the frame's: 0.12 to 1.3 in steps of 15 %. Refinement corrects half a step."""

_TURNS = range(0, 360, 15)
_BLUR = 1.2
_MAX_VIEWS = 4

Matrix = npt.NDArray[np.float64]


def search(views: Views) -> list[Projection]:
    """Similarities under which displayed pictures and reconstructions correlate best.

    Outside of the picture the display is assumed to be dark.

    Returns:
        The best of each quarter turn and mirroring: eight, best first.
    """
    import cv2

    views = views.first(_MAX_VIEWS)
    height, width = views.camera_size
    size = max(8, round(height * _SIDE / max(height, width))), max(8, round(width * _SIDE / max(height, width)))
    frames = [cv2.resize(each, size[::-1], interpolation=cv2.INTER_AREA) for each in views.reconstructions]
    seen = spectrum(torch.from_numpy(np.stack([_standard(frame) for frame in frames]))[None], size)[0]
    best: dict[tuple[bool, int], tuple[float, Projection]] = {}
    for scale in _SCALES:
        pictures = [_resized(each, scale * size[1]) for each in views.pictures]
        factor = scale * width / views.picture_size[1]
        for mirrored in (False, True):
            values, middles = _best_places(pictures, seen, size, mirrored=mirrored)
            for turn, value, middle in zip(_TURNS, values, middles, strict=True):
                quarter = mirrored, (turn + 45) // 90 % 4
                if value > best.get(quarter, (-np.inf,))[0]:
                    pixel = (middle + 0.5) * [width / size[1], height / size[0]] - 0.5
                    best[quarter] = value, _similarity(views, _turn(float(turn), mirrored=mirrored) * factor, pixel)
    return [projection for _, projection in sorted(best.values(), key=lambda each: -each[0])]


def _resized(picture: FloatFrame, width: float) -> FloatFrame:
    import cv2

    h, w = picture.shape
    size = max(2, round(width)), max(2, round(width * h / w))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _standard(image: FloatFrame) -> FloatFrame:
    """The image smoothed, with mean 0 and norm 1."""
    import cv2

    smooth = compress(np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR), np.float32))
    smooth -= smooth.mean()
    return smooth / max(float(np.linalg.norm(smooth)), 1e-9)


def _turn(degrees: float, *, mirrored: bool) -> Matrix:
    """Clockwise, after mirroring left to right."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if mirrored else 1.0, 1.0])


def _best_places(
    pictures: list[FloatFrame], seen: Tensor, size: Size, *, mirrored: bool
) -> tuple[list[float], list[Matrix]]:
    """Mean correlation of each turn at its best place, and that place (2,) of the picture's middle in the frame."""
    import cv2

    middle = (np.array(size[::-1]) - 1) / 2
    total = torch.zeros(len(_TURNS), *size)
    for picture, frame in zip(pictures, seen, strict=True):
        placed = []
        for turn in _TURNS:
            linear = _turn(float(turn), mirrored=mirrored)
            shift = middle - linear @ ((np.array(picture.shape[::-1]) - 1) / 2)
            placed.append(_standard(np.asarray(cv2.warpAffine(picture, np.column_stack([linear, shift]), size[::-1]))))
        shown = spectrum(torch.from_numpy(np.stack(placed))[None], size)
        total += inverse_spectrum(frame * shown.conj(), size, size)[0]
    values, places = (total / len(pictures)).flatten(1).max(1)
    shifts = [np.array([place % size[1], place // size[1]]) for place in places.tolist()]
    return values.tolist(), [(middle + shift) % size[::-1] for shift in shifts]  # correlation is circular


def _similarity(views: Views, linear: Matrix, middle: Matrix) -> Projection:
    """Put the middle of the picture to a pixel of the camera."""
    h, w = views.picture_size
    shift = middle - linear @ [(w - 1) / 2, (h - 1) / 2]
    matrix = np.vstack([np.column_stack([linear, shift]), [0, 0, 1]])
    return Projection.from_homography(matrix, views.picture_size, views.camera_size)
