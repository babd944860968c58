"""Pictures that show how well a registration fits."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from mwdn.io.contact_sheets import contact_sheet, to_display
from mwdn.io.images import srgb_decode, srgb_encode
from mwdn.registration.projection import Points
from mwdn.registration.residuals import Residuals
from mwdn.types import Image, Scene

_SIDE = 640
"""Least height of a drawing in pixels: a pixel of a small camera becomes a block."""

_GREEN, _ORANGE = (60, 220, 90), (255, 140, 30)
_ENLARGED = 10
"""Factor on the length of displacements in the drawing."""


def draw_outline(reconstruction: Image, corners: Points, residuals: Residuals | None = None) -> Tensor:
    """Draw a picture's outline, and the displacements of its parts ten times as long, on a reconstruction.

    Args:
        reconstruction: (1, C, H, W), linear light.
        corners: (4, 2), of the picture in pixels of the camera; a dot marks the first.
        residuals: of the registration.

    Returns:
        (1, 3, height, width) in linear light, at least 640 pixels high.
    """
    import cv2

    factor = max(1, -(-_SIDE // reconstruction.shape[-2]))
    grey = srgb_encode(to_display(reconstruction.float().clamp(min=0))).expand(-1, 3, -1, -1)[0].movedim(0, -1)
    canvas = np.ascontiguousarray((255 * grey).round().byte().cpu().numpy())
    canvas = cv2.resize(canvas, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    outline = _drawn(corners, factor)
    cv2.polylines(canvas, [outline], True, _GREEN, 1, cv2.LINE_AA, shift=4)
    cv2.circle(canvas, tuple(map(int, outline[0])), 5 << 4, _GREEN, -1, cv2.LINE_AA, shift=4)
    if residuals is not None:
        for start, shift in zip(residuals.seen, residuals.displacements, strict=True):
            ends = _drawn(np.stack([start, start + _ENLARGED * shift]), factor)
            cv2.circle(canvas, tuple(map(int, ends[0])), 2 << 4, _ORANGE, -1, cv2.LINE_AA, shift=4)
            cv2.polylines(canvas, [ends], False, _ORANGE, 1, cv2.LINE_AA, shift=4)
    return srgb_decode(torch.from_numpy(canvas / np.float32(255))).movedim(-1, 0)[None]


def overlay(reconstruction: Image, warped: Scene, corners: Points, residuals: Residuals | None = None) -> Tensor:
    """A sheet: the reconstruction with the outline, the displayed picture in the camera's frame, and both in one.

    In the last one the reconstruction is red and the displayed picture cyan: where they agree it is grey.

    Args:
        reconstruction: (1, C, H, W), linear light.
        warped: (1, C, H, W), the displayed picture in the camera's frame.
        corners: (4, 2), of the picture in pixels of the camera.
        residuals: of the registration.
    """
    seen, shown = (to_display(each.float().clamp(min=0)).mean(1, keepdim=True) for each in (reconstruction, warped))
    both = torch.cat([seen, shown, shown], 1)
    pictures = [draw_outline(reconstruction, corners, residuals), warped, both]
    return contact_sheet([pictures], ["reconstruction", "displayed picture", "both: red and cyan"], height=_SIDE)


def _drawn(points: Points, factor: int) -> npt.NDArray[np.int32]:
    """Points in sixteenths of a pixel of the enlarged canvas."""
    return np.round(((points + 0.5) * factor - 0.5) * 16).astype(np.int32)
