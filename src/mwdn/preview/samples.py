"""A camera to try: a simulated one, and captures of three photographs."""

from functools import cache

import torch

from mwdn.calibration import Calibration
from mwdn.data.random import seeded
from mwdn.io.images import encode_png
from mwdn.io.pictures import PICTURES, dark_scene
from mwdn.optics import Camera, Sensor, Variety, sample_camera
from mwdn.types import Frame

SAMPLE_CAMERA = "sample"
SIZE = (320, 320)
_PEAK = 0.8


@cache
def sample_calibration() -> Calibration:
    """A mask of contours, as the paper's."""
    variety = Variety(support=(0.5, 0.7), glow=(0.0, 0.05), halo=(0.0, 0.05), background=(0.0, 0.0))
    return Calibration(sample_camera(3, SIZE, family="contours", variety=variety))


@cache
def sample_capture(name: str) -> Frame:
    """A capture of a photograph on a dark wall, (H, W, 3) uint16, with the sensor's noise.

    Args:
        name: one of `PICTURES`.
    """
    light = Camera(sample_calibration().psf).forward(dark_scene(name, SIZE, side=200))
    exposed = Sensor().expose(light * (_PEAK / light.max()), generator=seeded(PICTURES.index(name)))
    return (exposed.clamp(0, 1) * 65535).round()[0].movedim(0, -1).to(torch.int32).numpy().astype("uint16")


@cache
def sample_png(name: str) -> bytes:
    """A sample capture as a PNG of 16 bits."""
    return encode_png(sample_capture(name), f"{name}.png")
