"""A camera that does not exist yet: its forward models, its sensor, and random PSFs of every kind of mask."""

from mwdn.optics.camera import Camera
from mwdn.optics.families import FAMILIES, Variety, sample_camera
from mwdn.optics.field import Aberration, FieldCamera, field_psfs
from mwdn.optics.sensor import Sensor

__all__ = [
    "FAMILIES",
    "Aberration",
    "Camera",
    "FieldCamera",
    "Sensor",
    "Variety",
    "field_psfs",
    "sample_camera",
]
