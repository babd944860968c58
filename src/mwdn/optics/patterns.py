"""Patterns of contour lines: what a contour mask aims at, and PSFs drawn without any optics."""

import math

import torch
from torch.nn import functional as F

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import filter_field, frequencies
from mwdn.optics.drawing import contour_lines
from mwdn.types import Plane, Psf, Size


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
    y = torch.linspace(-1, 1, height)[:, None]
    x = torch.linspace(-1, 1, width)
    aperture = ((1 - y.abs()) / 0.25).clamp(0, 1) * ((1 - x.abs()) / 0.25).clamp(0, 1)
    psf = contour_lines(field, line, 1e-3) * aperture
    return psf / psf.sum()


def contours(
    size: Size, *, line: float, spacing: float, irregularity: float = 0.15, generator: torch.Generator | None = None
) -> Plane:
    """Contour lines, 1 on their middle and 0 between them, at an even distance from each other.

    They are the zeros of noise of one wavelength and all directions. Its period is two lines; contours of ordinary
    Perlin noise, with lines in clusters and empty places between them, lack the ring in the spectrum that the measured
    PSF of the paper's camera has at one line in about 118 um.

    Args:
        size: height and width in samples.
        line: full width of a line at half its height, in samples.
        spacing: usual distance from one line to the next, in samples.
        irregularity: spread of the distances, as a part of ``spacing``.
        generator: source of the noise.

    Raises:
        ParameterError: lines closer than they are wide, narrower than a sample, or not within the frame; an
            irregularity outside (0, 1].
    """
    if not 1 <= line < spacing <= min(size):
        raise ParameterError(
            f"1 <= `line` ({line:g}) < `spacing` ({spacing:g}) <= the smaller side of {size} must hold, in samples. "
            "Use a finer pitch, or a larger mask."
        )
    if not 0 < irregularity <= 1:
        raise ParameterError(f"`irregularity` ({irregularity:g}) must be in (0, 1].")
    v, u = (frequencies(length) for length in size)
    periods = torch.hypot(v[:, None], u[None]) * (2 * spacing)
    ring = torch.exp(-0.5 * ((periods - 1) / irregularity).square()).to(torch.complex64)
    field = filter_field(torch.randn(size, generator=generator).to(torch.complex64), ring).real
    # The steepest slopes of such noise are about pi / spacing of its standard deviation; a place where it only
    # touches zero, with hardly any slope, would otherwise become a wide blot.
    return contour_lines(field / field.std(), line, 0.3 * math.pi / spacing)
