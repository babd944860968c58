"""A camera that does not exist yet: its forward model and its sensor."""

from mwdn.optics.camera import Camera
from mwdn.optics.sensor import Sensor

__all__ = ["Camera", "Sensor"]
