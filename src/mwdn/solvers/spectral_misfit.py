"""How well the best scene explains a measurement through a PSF, averaged over bands of frequencies.

With a smooth scene v fitted as in `mwdn.solvers.alignment`, residual ``r = b - h * v``, both under a
window w that fades at the frame's border, and bands k of radial frequencies:

    r_k = sum over band k of |F(w r)|^2,    b_k = sum over band k of |F(w b)|^2,    n_k = the noise in it
    log misfit = sum_k q_k log((r_k + n_k) / b_k) / sum_k q_k,    q_k = max(0, 1 - n_k / b_k)^2

Most of the energy of a capture's detail is at low frequencies, where some scene fits through almost any PSF: energies
of residuals hardly distinguish a wrong PSF from the right one. The logarithm gives each band the same weight, whatever
its energy. Without the window, the step at the border would fill the fine bands.
"""

from itertools import pairwise

import torch
from torch import Tensor

from mwdn.fourier.transforms import column_counts, frequency_grid, spectrum
from mwdn.optics.noise import noise_level
from mwdn.solvers.alignment import SMOOTH_LEVELS, halve_psf
from mwdn.solvers.pyramid import halve, solve
from mwdn.types import TINY, Image, Measurement, Psf

_BANDS = (0.03, 0.06, 0.09, 0.12, 0.16, 0.2, 0.25, 0.3, 0.36, 0.43, 0.5)
"""Edges in cycles per pixel. Below, most of the residual is ambient light."""

_FADE = 0.2
"""Part of the frame at each border over which the window fades in."""

MAX_MISFIT_PIXELS = 120_000
"""Pixels of the largest frame that is not halved: 8 PSFs of 320 x 320 pixels take a second on one core."""


@torch.no_grad()
def spectral_misfit(measurement: Measurement, psf: Psf) -> Tensor:
    """Misfit of the best scene through each PSF of a batch, averaged over bands of frequencies.

    Colours are averaged, and large frames halved until they have at most `MAX_MISFIT_PIXELS` pixels.

    Args:
        measurement: (1 or B, C, H, W).
        psf: (B, 1 or C, h, w), centred; used as it is.

    Returns:
        (B,), the log misfit above. PSFs of one measurement differ by the logarithm of the mean ratio of their
        residuals.
    """
    b, h = measurement.float().mean(1, keepdim=True), psf.float().mean(1, keepdim=True)
    b = b / b.abs().amax((1, 2, 3), keepdim=True).clamp(min=TINY)
    variance, halvings = noise_level(b).square().sum((1, 2, 3)), 0
    while b[0, 0].numel() > MAX_MISFIT_PIXELS:
        b, h, halvings = halve(b), halve_psf(h), halvings + 1
    residual = solve(b.expand(len(h), -1, -1, -1), h, SMOOTH_LEVELS).residual
    rows, columns = (_fade(length, b.device) for length in b.shape[-2:])
    window = rows[:, None] * columns
    bands, of_noise = _bands(b, halvings)
    r, d = (_energies(window * image, bands) for image in (residual, b))
    d = d.clamp(min=1e-30)
    n = variance[:, None] * window.square().sum() * of_noise
    q = (1 - n / d).clamp(min=0).square() * (of_noise > 0)  # small frames have bands without a frequency
    return (q * ((r + n).clamp(min=1e-30) / d).log()).sum(1) / q.sum(1).clamp(min=1e-6)


def _fade(length: int, device: torch.device) -> Tensor:
    """Window that rises as a cosine from 0 at each end to 1."""
    place = (torch.arange(length, device=device) + 0.5) / length
    return torch.sin(torch.pi / 2 * (torch.minimum(place, 1 - place) / _FADE).clamp(max=1)).square()


def _bands(image: Image, halvings: int) -> tuple[Tensor, Tensor]:
    """Whether a frequency of the half spectrum (pixels) belongs to a band, once or with its mirror image: (K, pixels).

    Also the sum in each band of the power spectrum of white noise of variance 1 after so many `halve`.
    """
    grid = image.shape[-2], image.shape[-1] + image.shape[-1] % 2
    rows, columns = frequency_grid(grid, device=image.device)
    radius = (rows.square() + columns.square()).sqrt().flatten()
    times = column_counts(grid[1], device=image.device).expand(grid[0], -1).flatten()
    bands = torch.stack([times * ((radius >= low) & (radius < high)) for low, high in pairwise(_BANDS)])
    return bands, bands @ (_noise_power(rows, halvings) * _noise_power(columns, halvings)).flatten()


def _noise_power(frequency: Tensor, halvings: int) -> Tensor:
    """Power spectrum along one axis of white noise after `halve`, whose transfer function is cos^3(pi f).

    Frequencies f / 2 and f / 2 + 1/2 become f, with half of their power each. What a second `halve` adds to the shape
    is neglected.
    """
    if not halvings:
        return torch.ones_like(frequency)
    half = torch.pi * frequency / 2
    return (half.cos() ** 6 + half.sin() ** 6) / 2**halvings


def _energies(image: Image, bands: Tensor) -> Tensor:
    """Energy in each band, (B, K)."""
    grid = image.shape[-2], image.shape[-1] + image.shape[-1] % 2
    return spectrum(image, grid).abs().square().sum(1).flatten(1) @ bands.T
