"""What random PSFs are drawn from: smooth fields, contour lines, light that rays leave."""

import math

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import filter_field, frequencies, frequency_grid, inverse_spectrum, spectrum
from mwdn.types import Plane, Size


def contour_lines(field: Tensor, line: float, flattest: float = 1e-3) -> Tensor:
    """Lines along the zeros of a smooth field (..., H, W).

    Args:
        field: whose zeros are drawn.
        line: full width of a line at half its height, in pixels.
        flattest: smallest slope a pixel that counts; where the field only touches zero, the line is not wider than
            with this slope.
    """
    slope = torch.stack(torch.gradient(field, dim=(-2, -1))).square().sum(0).sqrt()
    # Distance from the zero contour in pixels is value over slope; a line is a Gaussian of it.
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
    """Random Gaussian field (H, W) of zero mean and unit variance; it is periodic.

    Args:
        size: height and width in pixels.
        period: length of its waves in pixels.
        bandwidth: of their frequencies, over their mean. From 0.5 on the field is a smooth random one; towards 0
            it holds waves of all directions but one length, whose zero contours keep an even distance.
        generator: source of the field, on any device.
        device: where the field shall be.
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


def scatter_light(rows: Tensor, columns: Tensor, power: Tensor, size: Size) -> Tensor:
    """Light (H, W) of rays that arrive at pixel coordinates (N,) with a power (N,), shared by the 4 nearest pixels.

    The sum is one of integers, in steps of 2^-14 of the strongest ray: rays may then arrive in any order, as they
    do on a GPU, and the result is the same. 2^17 of the strongest rays fit on one pixel.
    """
    height, width = size[0] + 3, size[1] + 3
    scale = 2**14 / power.max().clamp(min=1e-20)
    # A border of one pixel above and left, two below and right, takes the rays that miss the frame.
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
