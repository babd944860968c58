"""PSFs for tests, drawn without any optics."""

import torch
from torch.nn import functional as F

from mwdn.optics.drawing import contour_lines


def contour_psf(size, *, line=1.2, cell=24, generator=None):
    """Bright contour lines of a smooth random field, like the PSF of a contour phase mask: (1, 1, *size), unit sum.

    Args:
        size: height and width in pixels.
        line: width of a line in pixels.
        cell: distance in pixels over which the field changes; the lines lie about this far apart.
        generator: source of the field.
    """
    height, width = size
    coarse = torch.randn(1, 1, height // cell + 3, width // cell + 3, generator=generator)
    field = F.interpolate(coarse, size=size, mode="bicubic", align_corners=True)
    y = torch.linspace(-1, 1, height)[:, None]
    x = torch.linspace(-1, 1, width)
    # Dark at the border, bright in the middle 3/4 of the frame.
    aperture = ((1 - y.abs()) / 0.25).clamp(0, 1) * ((1 - x.abs()) / 0.25).clamp(0, 1)
    psf = contour_lines(field, line) * aperture
    return psf / psf.sum()
