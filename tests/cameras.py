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


def gaussian_psf(size, sigma, centre=None):
    """A Gaussian of unit sum (1, 1, *size), at ``centre`` = (row, column) or in the middle."""
    row, column = centre or (size[0] // 2, size[1] // 2)
    y, x = torch.arange(size[0])[:, None] - row, torch.arange(size[1]) - column
    psf = torch.exp(-0.5 * (y.square() + x.square()) / sigma**2)
    return (psf / psf.sum())[None, None]
