"""PSFs for tests, drawn without any optics."""

import torch
from torch.nn import functional as F

from mwdn.optics.camera import Camera
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


def capture_of_rectangles(size, *, count, corners, rectangle, noise=0.004):
    """A PSF (1, 3, *size), a scene of coloured rectangles in darkness, and its capture with white noise.

    Args:
        size: height and width in pixels.
        count: number of rectangles.
        corners: first and last row and column of their upper left corners.
        rectangle: height and width of each.
        noise: standard deviation, as a fraction of the brightest light.
    """
    generator = torch.Generator().manual_seed(2)
    psf = contour_psf(size, generator=generator).expand(-1, 3, -1, -1)
    scene = torch.zeros(1, 3, *size)
    for _ in range(count):
        top, left = torch.randint(*corners, (2,), generator=generator).tolist()
        scene[..., top : top + rectangle[0], left : left + rectangle[1]] = torch.rand(3, 1, 1, generator=generator)
    light = Camera(psf).forward(scene)
    return psf, scene, light + noise * light.amax() * torch.randn(light.shape, generator=generator)


def gaussian_psf(size, sigma, centre=None):
    """A Gaussian of unit sum (1, 1, *size), at ``centre`` = (row, column) or in the middle."""
    row, column = centre or (size[0] // 2, size[1] // 2)
    y, x = torch.arange(size[0])[:, None] - row, torch.arange(size[1]) - column
    psf = torch.exp(-0.5 * (y.square() + x.square()) / sigma**2)
    return (psf / psf.sum())[None, None]
