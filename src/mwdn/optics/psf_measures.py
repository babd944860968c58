"""The shape of a PSF in numbers: autocorrelation, support, separability, similarity of two PSFs."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.fourier.convolution import correlate
from mwdn.fourier.transforms import fast_length, frequency_grid, gaussian_transfer, inverse_spectrum, spectrum
from mwdn.optics.displacement import displacement
from mwdn.optics.noise import noise_level
from mwdn.optics.psf_spectrum import ring_means
from mwdn.types import Psf, Size

LOSSLESS_WIDTH = 6.0
"""Full width of the autocorrelation, in binned pixels, down to which binning loses little; see `coarsest_bin`."""

MIN_BOX = 5
"""Pixels along each side of the lit part of a PSF, below which it is a spot without lines and gaps."""

MIN_BINNED_PX = 100
"""Fewest pixels of the shorter side of a frame that is binned automatically."""


def effective_rank(psf: Psf) -> float:
    """How many separable patterns (a column times a row) the mean of the channels consists of.

    With singular values s_i and ``p_i = s_i / sum s``, the exponential of their entropy, ``exp(-sum p_i log p_i)``:
    1 for a separable mask, n for n equal singular values.

    References:
        O. Roy and M. Vetterli, EUSIPCO 2007.
    """
    plane = psf.mean((0, 1)).double()
    plane = plane if plane.shape[0] <= plane.shape[1] else plane.T
    # Roots of the eigenvalues of P P^T: ten times as fast as the singular values of a large P.
    values = torch.linalg.eigvalsh(plane @ plane.T).clamp(min=0).sqrt()
    part = values / values.sum()
    return float(torch.exp(-(part * part.clamp(min=1e-300).log()).sum()))


class Autocorrelation(NamedTuple):
    """Normalised autocorrelation of a PSF's detail.

    ``image`` (H, W) is 1 at its centre; ``width`` is the peak's full width at half maximum; ``lobe`` is the highest
    value outside the peak, at the displacement ``lobe_at`` = (down, right), all in pixels.
    """

    image: Tensor
    width: float
    lobe: float
    lobe_at: tuple[int, int]


def autocorrelation(psf: Psf) -> Autocorrelation:
    """Autocorrelation of the PSF's detail: how sharp the PSF is, and whether its pattern repeats.

    Structure wider than about a tenth of the frame is removed first: the shape of the aperture would hide the detail.
    So is white noise, whose autocorrelation is a spike of one pixel on the peak.
    """
    plane = psf.mean((0, 1))
    height, width = plane.shape
    grid = fast_length(2 * height), fast_length(2 * width)
    power = _detail(plane, grid).abs().square()
    image = inverse_spectrum((power - _noise_power(plane, power, grid))[None, None], grid, grid)[0, 0]
    image = image.roll((height, width), (0, 1))[: 2 * height, : 2 * width]
    image = image / image[height, width].clamp(min=1e-30)
    y, x = torch.arange(len(image))[:, None] - height, torch.arange(image.shape[1]) - width
    distance = (y.square() + x.square()).float().sqrt()
    peak_width = _full_width(image.cpu(), distance)
    outside = torch.where(distance > 3 * peak_width, image.cpu(), -1.0)
    index = int(outside.argmax())
    lobe_at = index // outside.shape[1] - height, index % outside.shape[1] - width
    top, left = height - height // 2, width - width // 2
    middle = image[top : top + height, left : left + width]
    return Autocorrelation(middle.cpu(), peak_width, max(float(outside.max()), 0.0), lobe_at)


def coarsest_bin(psf: Psf) -> int:
    """Largest bin of PSF and captures that loses little; 1 for a PSF with sharp lines.

    Gaussian lines whose autocorrelation has a full width of w pixels have the transfer function
    ``exp(-1.8 (w f)^2)``. Binned by w / 6, the highest frequency is f = 3 / w, where it is 1e-7: no linear method
    resolves anything there. Solvers and networks restore edges on finer pixels, but this gains less than the errors of
    a calibrated PSF and the noise of finer pixels cost. Of 30 simulated captures with such errors through five PSFs,
    `pyramid` gains 0.3 dB on average and is 29 times as fast, `universal-small` loses 0.2 dB; with 3 % noise they gain
    0.8 and 0.2 dB. Binned by w / 4, they lose up to 2 dB.

    The shorter side of the binned frame keeps `MIN_BINNED_PX` pixels at least.

    Args:
        psf: (1, C, H, W), at the resolution of the captures.
    """
    return max(1, min(round(autocorrelation(psf).width / LOSSLESS_WIDTH), min(psf.shape[-2:]) // MIN_BINNED_PX))


def _detail(plane: Tensor, grid: Size) -> Tensor:
    """Spectrum of a picture less its Gaussian blur, whose standard deviation is 1/20 of the shorter side."""
    smooth = gaussian_transfer(grid, min(plane.shape) / 20, device=plane.device)
    return spectrum(plane[None, None], grid)[0, 0] * (1 - smooth)


def _noise_power(plane: Tensor, power: Tensor, grid: Size) -> Tensor:
    """Power of the white noise in a PSF's spectrum: the least of three upper bounds.

    Both lines and noise have power at high frequencies. The bounds are the power at the highest frequencies, where
    lines of two pixels and more have little; the noise of the dark areas between spots of one pixel; and half of the
    mean power, because a pattern that is white altogether is the PSF.
    """
    rows, columns = frequency_grid(grid, device=plane.device)
    highest = power[(rows.abs() > 0.4) & (columns.abs() > 0.4)].mean()
    in_dark = noise_level(plane[None, None], parts=1).square().sum() * plane.numel()
    return torch.stack([highest, in_dark, power.mean() / 2]).min()


def _full_width(image: Tensor, distance: Tensor) -> float:
    """Twice the distance at which the radial profile falls to 1/2, interpolated linearly between two rings."""
    count = int(distance.max().round()) + 1
    # The mean radius of a ring's pixels differs from the ring's number, above all near the peak.
    mean, radius = (ring_means(values, distance, count) for values in (image, distance))
    below = (mean < 0.5).nonzero()
    if not len(below):
        return 2 * float(radius[-1])
    i = int(below[0])
    part = (mean[i - 1] - 0.5) / (mean[i - 1] - mean[i])
    return 2 * float(radius[i - 1] + part * (radius[i] - radius[i - 1]))


def radial_autocorrelation(psf: Psf, reach: int = 40) -> Tensor:
    """Autocorrelation of the PSF less its mean at 0, 1, 2 ... pixels, over all directions and channels; 1 at 0."""
    centred = psf - psf.mean((-2, -1), keepdim=True)
    channels = centred.transpose(0, 1)
    total = torch.cat([correlate(channel[None], channel[None]) for channel in channels]).sum((0, 1))
    rows, columns = (torch.arange(n) - n // 2 for n in total.shape)
    distance = torch.hypot(rows[:, None].double(), columns.double())
    means = ring_means(total, distance, min(reach, min(total.shape) // 2))
    return means / means[0]


def autocorrelation_width(psf: Psf) -> float:
    """Full width at half maximum, in pixels, of the PSF's autocorrelation, averaged over directions and channels.

    Correlating a measurement with the PSF turns a point into a spot of this width: about 1.4 times the width of the
    PSF's finest structure.
    """
    profile = radial_autocorrelation(psf)
    below = int((profile < 0.5).nonzero()[0]) if (profile < 0.5).any() else len(profile) - 1
    step = (profile[below - 1] - 0.5) / (profile[below - 1] - profile[below]).clamp(min=1e-12)
    return 2 * (below - 1 + step.item())


@dataclass(frozen=True)
class Support:
    """Where the light of a PSF lies.

    Args:
        height: height in pixels of the box that leaves out 1 % of the light at each of its four sides.
        width: its width.
        offset: (down, right) from the PSF's centre to the light's centroid, in pixels.
        pixels: effective number of lit pixels, ``(sum h)^2 / sum h^2``.
        border: mean brightness in the outermost 2 % of the frame over that of the whole frame.
        glow: fraction of the light in an even level under the pattern, see `level_between_lines`.
        contrast: (bright - dark) / (bright + dark) in the box; bright is its 99th percentile, dark that level.
    """

    height: int
    width: int
    offset: tuple[float, float]
    pixels: float
    border: float
    glow: float
    contrast: float


def support_box(psf: Psf) -> tuple[slice, slice]:
    """Rows and columns of the box that leaves out 1 % of the light at each of its four sides."""
    plane = psf.mean((0, 1)).double().cpu()
    sums = [plane.sum(1 - axis).cumsum(0) / plane.sum() for axis in (0, 1)]
    rows, columns = (slice(int((part < 0.01).sum()), int((part < 0.99).sum()) + 1) for part in sums)
    return rows, columns


def level_between_lines(box: Tensor) -> float:
    """Brightness between the lines of a PSF: 10th percentile of the middle half (h/2, w/2) of its support box.

    0 for a box below `MIN_BOX`, which holds a single spot.
    """
    if min(box.shape) < MIN_BOX:
        return 0.0
    rows, columns = (slice(n // 4, max(3 * n // 4, n // 4 + 1)) for n in box.shape)
    ordered = box[rows, columns].flatten().sort().values
    return float(ordered[int(0.1 * (len(ordered) - 1))])


def support(psf: Psf) -> Support:
    """Measure where the light of the mean of the channels lies."""
    plane = psf.mean((0, 1)).double().cpu()
    plane = plane / plane.sum()
    offset = [float((plane.sum(1 - axis) * torch.arange(n)).sum()) - n // 2 for axis, n in enumerate(plane.shape)]
    box = plane[support_box(psf)]
    dark, bright = level_between_lines(box), float(box.flatten().sort().values[int(0.99 * (box.numel() - 1))])
    edge = max(min(plane.shape) // 50, 1)
    inner = plane[edge:-edge, edge:-edge] if min(plane.shape) > 2 * edge else plane[:0]
    border = (
        float((plane.sum() - inner.sum()) / (plane.numel() - inner.numel())) if inner.numel() else 1.0 / box.numel()
    )
    return Support(
        height=box.shape[0],
        width=box.shape[1],
        offset=(offset[0], offset[1]),
        pixels=float(1 / plane.square().sum()),
        border=max(border, 0.0) * plane.numel(),
        glow=float(plane.clamp(max=dark).sum()),
        contrast=(bright - dark) / max(bright + dark, 1e-30),
    )


def likeness(psf: Psf, other: Psf) -> float:
    """Peak of the normalised cross-correlation of two PSFs of one size; 1 for equal or merely displaced ones.

    The channels are averaged and the mean is subtracted first.
    """
    return displacement(psf, other).correlation
