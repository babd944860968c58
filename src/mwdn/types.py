"""Array types, with axis order and value range said once.

Every image in this package is a ``torch.Tensor`` of axes (batch, channel, height, width), float32, linear in
light, nominally in [0, 1], row 0 at the top, channels in the order R, G, B. A PSF has the same axes, is centred
at pixel ``(height // 2, width // 2)``, and has a batch of 1 unless each sample has its own.

A *frame* is an image as a file or a sensor stores it, before any of these conventions apply: a numpy array of axes
(height, width, channel), raw values of the analogue-to-digital converter.
"""

from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Complex, Float
from torch import Tensor

Size = tuple[int, int]
"""(height, width) in pixels."""

TINY = torch.finfo(torch.float32).tiny
"""Smallest normal float32: a floor for divisors, with which 0 / 0 is 0."""

Image = Float[Tensor, "batch channel height width"]
"""Any image; its size and channels need not match the other arguments."""

Measurement = Float[Tensor, "batch channel height width"]
"""Image on the sensor, black level subtracted, saturation at 1."""

Scene = Float[Tensor, "batch scene_channel scene_height scene_width"]
"""Image of the scene in front of the camera; it may be larger than the sensor."""

Psf = Float[Tensor, "psf_batch psf_channel psf_height psf_width"]
"""Response to a point; ``psf_batch`` and ``psf_channel`` are 1 or those of the image."""

Spectrum = Complex[Tensor, "batch channel height half_width"]
"""Half of a real image's Fourier transform, origin first."""

Transfer = Complex[Tensor, "transfer_batch transfer_channel grid_height half_grid_width"]
"""Transfer function of a filter or a PSF: half a spectrum on a grid; batch and channels are 1 or the picture's."""

Field = Complex[Tensor, "_height _width"]
"""Complex amplitude of monochromatic light on a plane, of any size; its squared modulus is the intensity."""

Plane = Float[Tensor, "_height _width"]
"""Real quantity on a plane, of any size: a height, a transmission, an intensity."""

Frame = npt.NDArray[Any]
"""(height, width, channel), RGB, uint8, uint16 or float, as stored."""

FloatFrame = npt.NDArray[np.float32]


@runtime_checkable
class ArrayPicture(Protocol):
    """A numpy array or a PIL picture: anything with numpy's array interface."""

    @property
    def __array_interface__(self) -> dict[str, Any]: ...


def size_of(image: Tensor) -> Size:
    """Height and width of an image (..., height, width)."""
    return image.shape[-2], image.shape[-1]
