"""Random fields and patterns of light: smooth fields, contour lines, caustics of rays."""

import math

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import filter_field, frequencies, frequency_grid, inverse_spectrum, spectrum
from mwdn.types import Plane, Size


def contour_lines(field: Tensor, line: float, flattest: float = 1e-3) -> Tensor:
    """Lines along the zeros of a smooth field (..., H, W).

    Args:
        field: the smooth field.
        line: full width of a line at half its maximum, in pixels.
        flattest: lower limit of the slope per pixel. Without it, flat places where the field only touches zero would
            become wide blots.
    """
    slope = torch.stack(torch.gradient(field, dim=(-2, -1))).square().sum(0).sqrt()
    # To first order the distance from the zero contour in pixels is field / |slope|. A line is a Gaussian of it;
    # 2.355 = 2 sqrt(2 ln 2) is its full width at half maximum over its standard deviation.
    distance = field / slope.clamp(min=flattest)
    return torch.exp(-0.5 * (distance / (line / 2.355)).square())


def smooth_field(
    size: Size,
    period: float,
    *,
    bandwidth: float = 1.0,
    generator: torch.Generator | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Random periodic Gaussian field (H, W) of zero mean and unit variance.

    Args:
        size: height and width in pixels.
        period: wavelength in pixels.
        bandwidth: relative spread of the frequencies. Towards 0 all waves have one length, in all directions, and
            the zero contours lie at even distances; from 0.5 on they are irregular.
        generator: source of randomness, on any device.
        device: of the result.
    """
    noise = torch.randn(size, generator=generator, device=generator.device if generator else None).to(device)
    rows, columns = frequency_grid(size, device=noise.device)
    distance = (rows.square() + columns.square()).sqrt() * period - 1
    window = torch.exp(-0.5 * (distance / bandwidth).square())
    window[0, 0] = 0
    field = inverse_spectrum(spectrum(noise[None, None], size) * window, size, size)[0, 0]
    return field / field.std(correction=0).clamp(min=1e-12)


def contours(
    size: Size, *, line: float, spacing: float, irregularity: float = 0.15, generator: torch.Generator | None = None
) -> Plane:
    """Contour lines at even distances: 1 on a line, 0 between lines.

    They are the zeros of noise with waves of one length in all directions; a period holds two lines. The measured PSF
    of the paper's camera has a ring in its spectrum, at one line in about 118 um, and so have these. Contours of Perlin
    noise, whose lines come in clusters with empty places between them, have no such ring.

    Args:
        size: height and width in samples.
        line: full width of a line at half its maximum, in samples.
        spacing: usual distance from one line to the next, in samples.
        irregularity: spread of the distances, as a part of ``spacing``.
        generator: source of randomness.

    Raises:
        ParameterError: not ``1 <= line < spacing <= min(size)``, or an irregularity outside (0, 1].
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
    # The steepest slopes are about pi / spacing standard deviations per sample: a sine of period 2 spacing.
    return contour_lines(field / field.std(), line, 0.3 * math.pi / spacing)


def scatter_light(rows: Tensor, columns: Tensor, power: Tensor, size: Size) -> Tensor:
    """Sum rays into pixels (H, W): each ray's power (N,) is shared bilinearly by the 4 pixels around its place (N,).

    Powers are summed as integers, in steps of 2^-14 of the strongest ray: the result does not depend on the order of
    the sum, which varies on a GPU. An int32 pixel holds 2^17 of the strongest rays.
    """
    height, width = size[0] + 3, size[1] + 3
    scale = 2**14 / power.max().clamp(min=1e-20)
    # Rays outside the frame land in a border, one pixel wide above and left and two below and right, cropped below.
    y, x = rows.clamp(-1, size[0]) + 1, columns.clamp(-1, size[1]) + 1
    top, left = y.int(), x.int()
    down, along = y - top, x - left
    corner, steps = top * width + left, power * scale
    light = torch.zeros(height * width, dtype=torch.int32, device=rows.device)
    below = steps * down
    for part, start in ((steps - below, 0), (below, width)):
        right = part * along
        light.index_add_(0, corner + start, (part - right).round().int())
        light.index_add_(0, corner + start + 1, right.round().int())
    return light.view(height, width)[1:-2, 1:-2].float() / scale
