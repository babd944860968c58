"""What a PSF can do, in numbers: autocorrelation, spectrum, noise gain, resolution, support."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import fast_length, frequency_grid, gaussian_transfer, inverse_spectrum, spectrum
from mwdn.types import Psf, Size

CONTRAST = 0.5
"""Standard deviation of a photograph's linear light over its mean; 0.4 to 0.8 is usual."""


def _power(psf: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """|H|^2 (..., H, W // 2 + 1) on the PSF's own grid, how often each number stands in it, and its frequency."""
    height, width = psf.shape[-2:]
    power = spectrum(psf, (height, width)).abs().square()
    # A column of the half spectrum stands for two, but for the first and, of an even width, the last.
    counts = torch.full((width // 2 + 1,), 2.0, device=psf.device)
    counts[0] = 1
    if width % 2 == 0:
        counts[-1] = 1
    rows, columns = frequency_grid((height, width), device=psf.device)
    return power, counts.expand(height, -1), (rows.square() + columns.square()).sqrt()


def _mean(values: Tensor, counts: Tensor) -> Tensor:
    return (values.double() * counts).sum((-2, -1)) / counts.sum()


def ring_means(values: Tensor, radius: Tensor, count: int, *, counts: Tensor | float = 1.0) -> Tensor:
    """Mean of the values on each ring around the origin, (count,) float64; 0 where a ring is empty.

    Args:
        values: (H, W).
        radius: of each value, (H, W); those that round to i are ring i.
        count: of rings; what lies beyond them is left out.
        counts: how often each value stands, (H, W).
    """
    ring, often = radius.round().long(), torch.as_tensor(counts, device=values.device).double().expand(values.shape)
    inside = ring < count
    total, weight = torch.zeros(2, count, dtype=torch.float64, device=values.device)
    total.index_add_(0, ring[inside], (values.double() * often)[inside])
    weight.index_add_(0, ring[inside], often[inside])
    return total / weight.clamp(min=1)


def noise_gain(psf: Psf, regularisation: float) -> tuple[float, ...]:
    """Variance of the Wiener estimate's noise over that of white noise in the measurement, for each channel.

    The mean over all frequencies of ``|H|^2 / (|H|^2 + lambda)^2``: each frequency is multiplied by the filter, and
    noise of different frequencies adds up in power. It falls as lambda grows.

    Raises:
        ParameterError: ``regularisation`` is not positive.
    """
    if not regularisation > 0:
        raise ParameterError(f"`regularisation` ({regularisation}) must be positive; try 1e-3.")
    power, counts, _ = _power(psf)
    gain = power / (power + regularisation).square()
    return tuple(_mean(gain, counts)[0].tolist())


def detail_kept(psf: Psf, regularisation: float) -> tuple[float, ...]:
    """Part of a picture's independent details that the Wiener estimate keeps: mean of ``|H|^2 / (|H|^2 + lambda)``."""
    power, counts, _ = _power(psf)
    return tuple(_mean(power / (power + regularisation), counts)[0].tolist())


class Rings(NamedTuple):
    """Spectrum by frequency: ``frequency`` in cycles per pixel, up to 0.5; mean power |H|^2 of each ring."""

    frequency: Tensor
    power: Tensor


def rings(psf: Psf) -> Rings:
    """Radial spectrum of a PSF, the mean of its channels' power."""
    power, counts, frequency = _power(psf)
    count = max(min(psf.shape[-2:]) // 2, 1)
    mean = ring_means(power.mean((0, 1)), frequency * 2 * count, count + 1, counts=counts)
    return Rings(torch.arange(count + 1) / (2 * count), mean.float().cpu())


def zeros(psf: Psf) -> tuple[float, tuple[float, ...]]:
    """Frequencies that the camera does not see, in the middle one of its colours.

    Returns:
        Part of all frequencies with less than 1/100 of the mean power of their ring, 0.01 for any random mask (its
        power is distributed exponentially); and the frequencies of rings, in cycles per pixel, that are dark as a
        whole: ten times darker than one of up to 1.5 times their frequency.
    """
    psf = psf[:, [psf.shape[1] // 2]]
    power, counts, frequency = _power(psf)
    mean = rings(psf)
    ring = (frequency * 2 * (len(mean.power) - 1)).round().long()
    inside = (ring > 0) & (ring < len(mean.power))
    weak = power[0, 0][inside] < 0.01 * mean.power.to(power)[ring[inside]]
    part = float((weak * counts[inside]).sum() / counts[inside].sum())
    p = mean.power
    dark = [
        p[i] < 0.1 * p[i + 1 : i + 2 + i // 2].max() and p[i] == p[max(i - 2, 0) : i + 3].min()
        for i in range(1, len(p) - 1)
    ]
    return part, tuple(float(mean.frequency[i + 1]) for i, found in enumerate(dark) if found)


def resolved_frequency(psf: Psf, noise: float) -> float:
    """Highest frequency, in cycles per pixel, at which a photograph still stands out of the measurement's noise.

    A photograph's power falls as ``1 / f^2``. It stands out where ``|H|^2 S(f) >= noise^2``, with S scaled to a
    contrast of `CONTRAST`. One ring in ten below the answer may fail. 0.5, a period of two pixels, is the most.

    Args:
        psf: of unit sum.
        noise: standard deviation of the measurement's noise over its mean.

    References:
        D. J. Field, J. Opt. Soc. Am. A 4, 2379 (1987), for the spectra of photographs.
    """
    _, counts, frequency = _power(psf)
    falling = 1 / frequency.clamp(min=1e-9).square()
    falling[0, 0] = 0
    scale = CONTRAST**2 / float(_mean(falling, counts))
    mean = rings(psf)
    visible = mean.power[1:] * scale / mean.frequency[1:].square() >= noise**2
    part = visible.float().cumsum(0) / torch.arange(1, len(visible) + 1)
    good = (visible & (part >= 0.9)).nonzero()
    return float(mean.frequency[1:][good[-1]]) if len(good) else 0.0


def effective_rank(psf: Psf) -> float:
    """How many separable patterns (a column times a row) the mean of the colours is made of.

    The exponential of the entropy of its singular values: 1 for a separable mask, n for n equal ones.

    References:
        O. Roy and M. Vetterli, EUSIPCO 2007.
    """
    plane = psf.mean((0, 1)).double()
    plane = plane if plane.shape[0] <= plane.shape[1] else plane.T
    # Eigenvalues of the smaller product: ten times as fast as singular values of a large frame.
    values = torch.linalg.eigvalsh(plane @ plane.T).clamp(min=0).sqrt()
    part = values / values.sum()
    return float(torch.exp(-(part * part.clamp(min=1e-300).log()).sum()))


class Autocorrelation(NamedTuple):
    """Likeness of a PSF's detail with itself displaced.

    ``image`` (H, W) is 1 at its centre; ``width`` is the peak's at half its height; ``lobe`` is the highest value
    beside the peak, and lies at ``lobe_at`` = (down, along), all in pixels.
    """

    image: Tensor
    width: float
    lobe: float
    lobe_at: tuple[int, int]


def autocorrelation(psf: Psf) -> Autocorrelation:
    """Likeness of the PSF's detail with itself displaced: how sharp it is, and whether it repeats.

    What is wider than about a tenth of the frame is taken out first: the shape of the aperture would hide the rest.
    """
    plane = psf.mean((0, 1))
    height, width = plane.shape
    grid = fast_length(2 * height), fast_length(2 * width)
    power = _detail(plane, grid).abs().square()
    image = inverse_spectrum(power[None, None], grid, grid)[0, 0]
    image = image.roll((height, width), (0, 1))[: 2 * height, : 2 * width]
    image = image / image[height, width].clamp(min=1e-30)
    y, x = torch.arange(len(image))[:, None] - height, torch.arange(image.shape[1]) - width
    distance = (y.square() + x.square()).float().sqrt()
    full = _half_width(image.cpu(), distance)
    beside = torch.where(distance > 3 * full, image.cpu(), -1.0)
    at = int(beside.argmax())
    where = at // beside.shape[1] - height, at % beside.shape[1] - width
    top, left = height - height // 2, width - width // 2
    middle = image[top : top + height, left : left + width]
    return Autocorrelation(middle.cpu(), full, max(float(beside.max()), 0.0), where)


def _detail(plane: Tensor, grid: Size) -> Tensor:
    """Spectrum of a picture without what is wider than 1/20 of its shorter side (standard deviation)."""
    smooth = gaussian_transfer(grid, min(plane.shape) / 20, device=plane.device)
    return spectrum(plane[None, None], grid)[0, 0] * (1 - smooth)


def _half_width(image: Tensor, distance: Tensor) -> float:
    """Twice the distance at which the mean over a ring falls to 1/2, on the line between two rings."""
    count = int(distance.max().round()) + 1
    # A ring holds the pixels of more or less its distance; not exactly so near the peak.
    mean, radius = (ring_means(values, distance, count) for values in (image, distance))
    below = (mean < 0.5).nonzero()
    if not len(below):
        return 2 * float(radius[-1])
    i = int(below[0])
    part = (mean[i - 1] - 0.5) / (mean[i - 1] - mean[i])
    return 2 * float(radius[i - 1] + part * (radius[i] - radius[i - 1]))


@dataclass(frozen=True)
class Support:
    """Where the light is.

    Args:
        height: of the box in pixels that leaves out 1 % of the light at each of its sides.
        width: likewise.
        offset: (down, along) of the light's centroid from the PSF's centre, in pixels.
        pixels: effective count of lit pixels, ``(sum h)^2 / sum h^2``.
        border: mean brightness in the outermost 2 % of the frame over that of the whole frame.
        glow: part of the light that fills the lit part evenly, up to the level between the lines.
        contrast: (bright - dark) / (bright + dark), of the box's 99th percentile and the level between the lines.
    """

    height: int
    width: int
    offset: tuple[float, float]
    pixels: float
    border: float
    glow: float
    contrast: float


def lit_box(psf: Psf) -> tuple[slice, slice]:
    """Rows and columns of the box that leaves out 1 % of the light at each of its sides."""
    plane = psf.mean((0, 1)).double().cpu()
    runs = [plane.sum(1 - axis).cumsum(0) / plane.sum() for axis in (0, 1)]
    rows, columns = (slice(int((run < 0.01).sum()), int((run < 0.99).sum()) + 1) for run in runs)
    return rows, columns


def between_lines(box: Tensor) -> float:
    """Level between the lines of a lit box (h, w): the 10th percentile of its middle, where its edges do not count."""
    rows, columns = (slice(n // 4, max(3 * n // 4, n // 4 + 1)) for n in box.shape)
    ordered = box[rows, columns].flatten().sort().values
    return float(ordered[int(0.1 * (len(ordered) - 1))])


def support(psf: Psf) -> Support:
    """Measure the light's extent, of the mean of the colours."""
    plane = psf.mean((0, 1)).double().cpu()
    plane = plane / plane.sum()
    centre = [float((plane.sum(1 - axis) * torch.arange(n)).sum()) - n // 2 for axis, n in enumerate(plane.shape)]
    box = plane[lit_box(psf)]
    dark, bright = between_lines(box), float(box.flatten().sort().values[int(0.99 * (box.numel() - 1))])
    edge = max(min(plane.shape) // 50, 1)
    inner = plane[edge:-edge, edge:-edge] if min(plane.shape) > 2 * edge else plane[:0]
    border = (
        float((plane.sum() - inner.sum()) / (plane.numel() - inner.numel())) if inner.numel() else 1.0 / box.numel()
    )
    return Support(
        box.shape[0],
        box.shape[1],
        (centre[0], centre[1]),
        float(1 / plane.square().sum()),
        max(border, 0.0) * plane.numel(),
        float(plane.clamp(max=dark).sum()),
        (bright - dark) / max(bright + dark, 1e-30),
    )


def likeness(psf: Psf, other: Psf) -> float:
    """Correlation of two PSFs of one size at the displacement where they agree best; 1 if they are the same.

    Of the mean of the colours, from each of which its mean is taken.
    """
    planes = [each.mean((0, 1)) - each.mean() for each in (psf, other)]
    grid = fast_length(2 * psf.shape[-2]), fast_length(2 * psf.shape[-1])
    first, second = (spectrum(plane[None, None], grid) for plane in planes)
    best = inverse_spectrum(first * second.conj(), grid, grid).max()
    return float(best / (planes[0].norm() * planes[1].norm()).clamp(min=1e-30))


def sensitivity(
    psf_at: Callable[[float], Psf], places: Iterable[float], *, reference: float = 0.0
) -> tuple[float, ...]:
    """How much the PSF changes with the distance or the angle of the point: its `likeness` with a reference.

    Args:
        psf_at: gives the PSF for a point at a place, for example of a designed mask.
        places: distances or angles, in the unit of ``psf_at``.
        reference: the place of the PSF that all are compared with.
    """
    known = psf_at(reference)
    return tuple(likeness(psf_at(place), known) for place in places)
