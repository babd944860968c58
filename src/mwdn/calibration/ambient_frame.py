"""Remove the noise of the ambient frame, which would otherwise be added to each capture."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.calibration.isolated_pixels import find_isolated_pixels
from mwdn.calibration.pixel_repair import PixelRepair
from mwdn.fourier.transforms import inverse_spectrum, plane_spectrum
from mwdn.optics.noise import noise_level
from mwdn.types import Image

PART = 16
"""Side in pixels of the parts of a frame in which noise and light are compared."""

QUIET = 0.3
"""The noise is this quantile of the bright parts' variance over light: that of parts without sharp lines of the mask,
which look like noise."""

NEIGHBOURS = 7
"""Side of the square of frequencies over which power is averaged; noise alone then scatters by sqrt(2) / 7 = 20 %."""

EXCESS = 1.5
"""Factor on the noise's power in the Wiener filter, so that noise that scatters above its mean is removed, too."""

UNEVEN = 1.3
"""The filter is not used if the 95 % quantile of the bright parts' removed power over light exceeds its mean by this
factor: then more than noise was removed. Noise has 1.13 to 1.2: its power scatters by sqrt(2 / 256) = 9 % from part to
part."""


def denoise_ambient(ambient: Tensor, dark: Tensor | None = None, cell: int = 1) -> Tensor:
    """Remove the noise of a frame of the room's light.

    Light of a room is smooth behind a mask, noise is white. So each frequency k of the frame's cosine transform, of
    power P(k), is multiplied by the gain of a Wiener filter, ``max(0, 1 - EXCESS sigma^2 / P(k))``. Structure whose
    power exceeds that of the noise stays. Hot pixels stay, because captures have them, too. With a dark frame of the
    same exposure its fixed pattern stays. If what was removed is not noise, such as the sharp lines of a lamp seen as
    a point through the mask, the frame stays as it is.

    Args:
        ambient: (1, C or 1, H, W), raw frame with the dark level, as a fraction of the full scale.
        dark: (1, C or 1, H, W), raw frame taken without light; not used if it has another size.
        cell: 2 for a mosaic, whose four kinds of pixels are filtered separately.

    Returns:
        (1, C or 1, H, W), with the dark level. Frames of less than 32 pixels along an axis, or with NaN, stay as they
        are.
    """
    if min(ambient.shape[-2:]) < 2 * PART * cell or any(length % cell for length in ambient.shape[-2:]):
        return ambient
    if dark is None or dark.shape[-2:] != ambient.shape[-2:]:
        dark = ambient.new_zeros(1, 1, 1, 1)
    light = (ambient - dark).float()
    if not light.isfinite().all():
        return ambient
    hot = find_isolated_pixels(light, cell=cell) | find_isolated_pixels(dark.float().expand_as(light), cell=cell)
    planes = F.pixel_unshuffle(PixelRepair(hot[0, 0], cell)(light), cell)
    smooth = F.pixel_shuffle(torch.cat([_smooth(plane) for plane in torch.split(planes, 1, dim=1)], dim=1), cell)
    return torch.where(hot, ambient, smooth + dark)


def _smooth(plane: Image) -> Image:
    """A plane (1, 1, H, W) without its noise, or as it is if more than noise was removed."""
    parts = _parts(plane)
    light = parts.mean((-2, -1)).flatten()
    if not light.mean() > 0:
        return plane
    bright = light >= 0.99 * light.mean()  # at least one, also after rounding
    smooth = _wiener(plane, plane.mean() * _noise_per_light(parts[bright], light[bright]))
    removed = _parts(smooth - plane).square().mean((-2, -1)).flatten()[bright] / light[bright]
    return plane if removed.quantile(0.95) > UNEVEN * removed.mean() else smooth


def _noise_per_light(parts: Image, light: Tensor) -> Tensor:
    """Variance of the noise over the light, which is the same everywhere for photons.

    Pixels two apart are compared, too, because the colours of an unknown mosaic are not noise.
    """
    apart = noise_level(F.pixel_unshuffle(parts, 2), parts=1).square().mean(1, keepdim=True)
    variance = torch.minimum(noise_level(parts, parts=1).square(), apart).flatten()
    return (variance / light).quantile(QUIET)


def _parts(plane: Image) -> Tensor:
    """Parts (N, 1, PART, PART) of a plane (1, 1, H, W)."""
    return plane[0].unfold(1, PART, PART).unfold(2, PART, PART).flatten(1, 2).transpose(0, 1)


def _wiener(plane: Image, noise_power: Tensor) -> Image:
    """Filter a plane (1, 1, H, W) in the cosine transform: the Fourier transform of the plane and its mirror images."""
    height, width = plane.shape[-2:]
    grid = 2 * height, 2 * width
    mirrored = torch.cat([plane, plane.flip(-1)], -1)
    spectrum = plane_spectrum(torch.cat([mirrored, mirrored.flip(-2)], -2), grid)
    margin = NEIGHBOURS // 2
    power = F.pad(spectrum.abs().square_(), (0, 0, margin, margin), mode="circular")  # the last row is -1
    power = F.avg_pool2d(F.pad(power, (margin, margin, 0, 0), mode="reflect"), NEIGHBOURS, 1) / (grid[0] * grid[1])
    spectrum *= (1 - EXCESS * noise_power / power.clamp_(min=torch.finfo(power.dtype).tiny)).clamp_(min=0)
    return inverse_spectrum(spectrum, grid, (height, width))
