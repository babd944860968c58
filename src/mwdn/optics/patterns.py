"""PSFs drawn without any optics, for demonstrations and tests."""

import torch
from torch.nn import functional as F

from mwdn.errors import ParameterError
from mwdn.fourier import Size
from mwdn.types import Psf


def contour_psf(size: Size, *, line: float = 1.2, cell: int = 24, generator: torch.Generator | None = None) -> Psf:
    """Bright contour lines of a smooth random field, like the PSF of a contour phase mask.

    Args:
        size: height and width in pixels.
        line: width of a line in pixels.
        cell: distance in pixels over which the field changes; the lines lie about this far apart.
        generator: source of the field.

    Returns:
        (1, 1, *size), unit sum, brightest in the middle 3/4 of the frame and dark at its border.

    Raises:
        ParameterError: lines closer than they are wide, or a frame smaller than a cell.

    References:
        V. Boominathan et al., PhlatCam, IEEE TPAMI 42, 1618 (2020): contours of Perlin noise have the sharp lines
        of all orientations whose spectrum has no zeros.
    """
    height, width = size
    if not 0 < line < cell <= min(size):
        raise ParameterError(f"`line` ({line}) < `cell` ({cell}) <= the smaller side of {size} must hold.")
    coarse = torch.randn(1, 1, height // cell + 3, width // cell + 3, generator=generator)
    field = F.interpolate(coarse, size=size, mode="bicubic", align_corners=True)
    slope = torch.stack(torch.gradient(field, dim=(-2, -1))).square().sum(0).sqrt()
    # Distance from the zero contour in pixels is value over slope; a line is a Gaussian of it.
    distance = field / slope.clamp(min=1e-3)
    y = torch.linspace(-1, 1, height)[:, None]
    x = torch.linspace(-1, 1, width)
    aperture = ((1 - y.abs()) / 0.25).clamp(0, 1) * ((1 - x.abs()) / 0.25).clamp(0, 1)
    psf = torch.exp(-0.5 * (distance / (line / 2.355)).square()) * aperture
    return psf / psf.sum()
