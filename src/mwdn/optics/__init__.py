"""Lensless cameras in software: masks, propagation of light, PSFs, forward models, the sensor."""

from mwdn.optics.amplitude_masks import CodedAperture, Pinholes, ZoneAperture
from mwdn.optics.array_mask import ArrayMask
from mwdn.optics.camera import Camera
from mwdn.optics.deviation import Deviation
from mwdn.optics.field import Aberration, FieldCamera, field_psfs
from mwdn.optics.masks import Mask, MaskDesign, mask_psf
from mwdn.optics.phase_masks import Contour, Diffuser, Lenslets
from mwdn.optics.psf import unit_sum
from mwdn.optics.random_psf import FAMILIES, Variety, sample_camera
from mwdn.optics.sensor import Sensor
from mwdn.optics.setup import Setup

MASKS: dict[str, type[MaskDesign]] = {
    "contour": Contour,
    "diffuser": Diffuser,
    "lenslets": Lenslets,
    "zone": ZoneAperture,
    "coded": CodedAperture,
    "pinholes": Pinholes,
}
"""Every kind of mask that parameters describe, by its name in `mwdn design`; `ArrayMask` is read from a file."""

__all__ = [
    "Aberration",
    "ArrayMask",
    "Camera",
    "CodedAperture",
    "Contour",
    "Deviation",
    "Diffuser",
    "FAMILIES",
    "FieldCamera",
    "Lenslets",
    "MASKS",
    "Mask",
    "Pinholes",
    "Sensor",
    "Setup",
    "Variety",
    "ZoneAperture",
    "field_psfs",
    "mask_psf",
    "sample_camera",
    "unit_sum",
]
