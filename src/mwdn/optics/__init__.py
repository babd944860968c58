"""Lensless cameras in software: masks, propagation of light, PSFs, forward models, the sensor."""

from dataclasses import MISSING, fields, is_dataclass

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
from mwdn.runtime.plugins import Registry


def _is_mask(entry: object) -> bool:
    """Whether an entry is a dataclass with a default for each field and a method ``build``."""
    if not isinstance(entry, type) or not is_dataclass(entry) or not callable(getattr(entry, "build", None)):
        return False
    return not any(field.default is field.default_factory is MISSING for field in fields(entry))


MASKS: Registry[type[MaskDesign]] = Registry(
    {
        "contour": Contour,
        "diffuser": Diffuser,
        "lenslets": Lenslets,
        "zone": ZoneAperture,
        "coded": CodedAperture,
        "pinholes": Pinholes,
    },
    "mwdn.masks",
    accepts=_is_mask,
    must_be="a dataclass with a default for each field and a method `build(setup)` that returns a `mwdn.optics.Mask`",
)
"""Kinds of masks that have parameters, by their names in `mwdn design`, including those of plugins. `ArrayMask` is read
from a file instead."""

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
