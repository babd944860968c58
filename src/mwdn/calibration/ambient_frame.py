"""The ambient frame without its noise, which would otherwise be added to each capture."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.calibration.frame_operations import subtract_dark
from mwdn.calibration.isolated_pixels import find_isolated_pixels
from mwdn.calibration.pixel_repair import PixelRepair
from mwdn.fourier.transforms import inverse_spectrum, plane_spectrum
from mwdn.optics.noise import noise_level
from mwdn.types import Image

PART = 16
"""Side of the parts, in pixels, in which noise and light are compared."""

QUIET = 0.3
"""Quantile of the parts' ratio of noise to light: the mask's lines, which look like noise, raise the others."""

NEIGHBOURS = 7
"""Side of the square of frequencies over which power is averaged; noise alone then scatters by sqrt(2) / 7 = 20 %."""

EXCESS = 1.5
"""How many times the noise's power counts, so that what scatters above its mean is removed, too."""


def denoise_ambient(ambient: Image, dark: Tensor | None = None, cell: int = 1) -> Image:
    """Remove the noise of a frame of the room's light.

    Light of a room is smooth behind a mask, noise is white. So each frequency k of the frame's cosine transform, of
    power P(k), is multiplied by the gain of a Wiener filter, ``max(0, 1 - EXCESS sigma^2 / P(k))``. Structure whose
    power exceeds that of the noise stays, such as a lamp seen through the mask. So do hot pixels, which the dark level
    of each capture has, too, and with a dark frame all its pattern.

    Args:
        ambient: (1, C, H, W), raw frame with the dark level, as a fraction of the full scale.
        dark: (1, C or 1, H, W), raw frame taken without light.
        cell: 2 for a mosaic, whose four kinds of pixels are filtered separately.

    Returns:
        (1, C, H, W), with the dark level.

    Raises:
        ShapeError: the dark frame has another size.
    """
    if min(ambient.shape[-2:]) < PART * cell or any(length % cell for length in ambient.shape[-2:]):
        return ambient
    light = ambient if dark is None else subtract_dark(ambient, dark)
    hot = find_isolated_pixels(light, cell=cell)
    planes = F.pixel_unshuffle(PixelRepair(hot[0, 0], cell)(light), cell)
    one_by_one = [_wiener(plane, _noise_power(plane)) for plane in torch.split(planes, 1, dim=1)]
    smooth = F.pixel_shuffle(torch.cat(one_by_one, dim=1), cell)
    return torch.where(hot, ambient, smooth if dark is None else smooth + dark)


def _noise_power(plane: Image) -> Tensor:
    """Mean variance of the noise of a plane (1, 1, H, W), which is that of photons: a number times the light."""
    parts = plane[0].unfold(1, PART, PART).unfold(2, PART, PART).flatten(1, 2).transpose(0, 1)
    light = parts.mean((-2, -1)).clamp(min=torch.finfo(parts.dtype).tiny)
    ratio = noise_level(parts, parts=1)[..., 0, 0].square() / light
    return ratio.quantile(QUIET) * plane.mean().clamp(min=0)


def _wiener(plane: Image, noise_power: Tensor) -> Image:
    """Filter a plane (1, 1, H, W) in the cosine transform: the Fourier transform of it beside its mirror images."""
    height, width = plane.shape[-2:]
    grid = 2 * height, 2 * width
    mirrored = torch.cat([plane, plane.flip(-1)], -1)
    spectrum = plane_spectrum(torch.cat([mirrored, mirrored.flip(-2)], -2), grid)
    margin = (NEIGHBOURS // 2,) * 4
    power = F.avg_pool2d(F.pad(spectrum.abs().square_(), margin, mode="reflect"), NEIGHBOURS, 1) / (grid[0] * grid[1])
    spectrum *= (1 - EXCESS * noise_power / power.clamp_(min=torch.finfo(power.dtype).tiny)).clamp_(min=0)
    return inverse_spectrum(spectrum, grid, (height, width))
