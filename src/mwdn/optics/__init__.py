"""A camera that does not exist yet: its forward model, its sensor, and random PSFs of every kind of mask."""

from mwdn.optics.camera import Camera
from mwdn.optics.families import FAMILIES, Variety, sample_camera
from mwdn.optics.sensor import Sensor

__all__ = ["FAMILIES", "Camera", "Sensor", "Variety", "sample_camera"]
