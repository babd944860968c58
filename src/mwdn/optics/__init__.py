"""A camera that does not exist yet: its mask, the light behind it, its forward model and its sensor."""

from mwdn.optics.amplitude_masks import CodedAperture, Pinholes, ZoneAperture
from mwdn.optics.camera import Camera
from mwdn.optics.masks import Mask, mask_psf
from mwdn.optics.phase_masks import Contour, Diffuser, Lenslets
from mwdn.optics.sensor import Sensor
from mwdn.optics.setup import Setup

__all__ = [
    "Camera",
    "CodedAperture",
    "Contour",
    "Diffuser",
    "Lenslets",
    "Mask",
    "Pinholes",
    "Sensor",
    "Setup",
    "ZoneAperture",
    "mask_psf",
]
