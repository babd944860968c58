"""Photographs included in the package."""

from importlib.resources import files
from typing import Literal, get_args

from torch.nn import functional as F

from mwdn.io.images import read_picture
from mwdn.types import Scene, Size

__all__ = ["PICTURES", "Picture", "dark_scene"]

Picture = Literal["astronaut", "coffee", "cat"]
PICTURES: tuple[Picture, ...] = get_args(Picture)
"""Names of the photographs."""


def dark_scene(name: str, size: Size, side: int) -> Scene:
    """A photograph in the centre of a dark scene, (1, 3, *size), in linear light.

    Args:
        name: one of `PICTURES`.
        size: height and width of the scene.
        side: height and width of the photograph.
    """
    picture = F.interpolate(read_picture(str(files("mwdn.io.pictures") / f"{name}.jpg")), (side, side), mode="area")
    (height, width), top, left = size, (size[0] - side) // 2, (size[1] - side) // 2
    return F.pad(picture, (left, width - side - left, top, height - side - top))
