"""Which frequencies a PSF passes: radial spectrum, zeros, noise gain, resolution.

H is the transfer function, the Fourier transform of the PSF; frequencies are in cycles per pixel, 0.5 at most.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import column_counts, frequency_grid, spectrum
from mwdn.types import Image, Psf, size_of

SCENE_CONTRAST = 0.5
"""Standard deviation of a photograph's linear light over its mean; 0.4 to 0.8 is usual."""


def _power(psf: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """|H|^2 (..., H, W // 2 + 1) on the PSF's own grid, the multiplicity of each value, and its frequency."""
    height, width = psf.shape[-2:]
    power = spectrum(psf, (height, width)).abs().square()
    counts = column_counts(width, device=psf.device)
    rows, columns = frequency_grid((height, width), device=psf.device)
    return power, counts.expand(height, -1), (rows.square() + columns.square()).sqrt()


def _mean(values: Tensor, counts: Tensor) -> Tensor:
    return (values.double() * counts).sum((-2, -1)) / counts.sum()


def ring_means(values: Tensor, radius: Tensor, count: int, *, counts: Tensor | float = 1.0) -> Tensor:
    """Radial profile: mean of the values on each ring around the origin, (count,) float64; 0 on an empty ring.

    Args:
        values: (H, W).
        radius: of each value, (H, W). Ring i holds the radii that round to i.
        count: number of rings; values beyond the last one are ignored.
        counts: multiplicity of each value, (H, W).
    """
    ring, weights = radius.round().long(), torch.as_tensor(counts, device=values.device).double().expand(values.shape)
    inside = ring < count
    total, weight = torch.zeros(2, count, dtype=torch.float64, device=values.device)
    total.index_add_(0, ring[inside], (values.double() * weights)[inside])
    weight.index_add_(0, ring[inside], weights[inside])
    return total / weight.clamp(min=1)


def noise_gain(psf: Psf, regularisation: float) -> tuple[float, ...]:
    """Variance of the noise in the Wiener estimate over that of white noise in the measurement, for each channel.

    The Wiener filter is ``conj(H) / (|H|^2 + lambda)``, and noise of different frequencies adds up in power, so the
    gain is the mean over all frequencies of ``|H|^2 / (|H|^2 + lambda)^2``. It falls as lambda grows.

    Raises:
        ParameterError: ``regularisation`` is not positive.
    """
    if not regularisation > 0:
        raise ParameterError(f"`regularisation` ({regularisation}) must be positive; try 1e-3.")
    power, counts, _ = _power(psf)
    gain = power / (power + regularisation).square()
    return tuple(_mean(gain, counts)[0].tolist())


def detail_kept(psf: Psf, regularisation: float) -> tuple[float, ...]:
    """Mean gain of the Wiener estimate over all frequencies, ``|H|^2 / (|H|^2 + lambda)``, for each channel."""
    power, counts, _ = _power(psf)
    return tuple(_mean(power / (power + regularisation), counts)[0].tolist())


class RadialPower(NamedTuple):
    """Power spectrum by frequency: ``frequency`` in cycles per pixel, up to 0.5; mean |H|^2 on each ring."""

    frequency: Tensor
    power: Tensor


def radial_power(psf: Psf, count: int | None = None) -> RadialPower:
    """Radial profile of |H|^2, averaged over the channels, at ``count`` + 1 frequencies from 0 to 0.5."""
    power, counts, frequency = _power(psf)
    count = count or max(min(psf.shape[-2:]) // 2, 1)
    mean = ring_means(power.mean((0, 1)), frequency * 2 * count, count + 1, counts=counts)
    return RadialPower(torch.arange(count + 1) / (2 * count), mean.float().cpu())


def radial_spectrum(psf: Psf, bins: int = 60) -> Tensor:
    """Radial profile of |H| on ``bins`` frequencies from 0 up to 0.5: root mean square over directions and channels."""
    power = radial_power(psf, bins).power[:-1]
    return (power / power[0] * psf.sum((-2, -1)).square().mean()).sqrt()


def modulus_image(psf: Psf) -> Image:
    """|H| as a picture on a logarithmic scale, frequency 0 in the middle: white is its maximum, black 0.001 of it."""
    size = size_of(psf)
    half = spectrum(psf.mean(1, keepdim=True), size).abs()
    # |H| of a real PSF is symmetric, |H(-v, -u)| = |H(v, u)|: the missing half is this one, turned by 180 degrees.
    turned = half[..., 1 : size[1] - size[1] // 2].flip(-1)
    turned = torch.cat([turned[..., :1, :], turned[..., 1:, :].flip(-2)], dim=-2)
    modulus = torch.cat([half, turned], dim=-1).roll((size[0] // 2, (size[1] - 1) // 2), dims=(-2, -1))
    return (1 + (modulus / modulus.amax()).clamp(min=1e-3).log10() / 3) ** 2.2


def spectral_zeros(psf: Psf) -> tuple[float, tuple[float, ...]]:
    """Frequencies that the camera hardly passes, in its middle channel.

    Returns:
        Part of all frequencies with less than 1/100 of the mean power of their ring, 0.01 for any random mask (its
        power is distributed exponentially); and the frequencies of dark rings, in cycles per pixel: local minima ten
        times darker than some ring of up to 1.5 times their frequency.
    """
    psf = psf[:, [psf.shape[1] // 2]]
    power, counts, frequency = _power(psf)
    mean = radial_power(psf)
    ring = (frequency * 2 * (len(mean.power) - 1)).round().long()
    inside = (ring > 0) & (ring < len(mean.power))
    weak = power[0, 0][inside] < 0.01 * mean.power.to(power)[ring[inside]]
    part = float((weak * counts[inside]).sum() / counts[inside].sum())
    p = mean.power
    dark = [
        i
        for i in range(1, len(p) - 1)
        if p[i] < 0.1 * p[i + 1 : i + 2 + i // 2].max() and p[i] == p[max(i - 2, 0) : i + 3].min()
    ]
    return part, tuple(float(mean.frequency[i]) for i in dark)


def resolved_frequency(psf: Psf, noise: float) -> float:
    """Highest frequency, in cycles per pixel, at which a photograph exceeds the measurement's noise.

    A photograph's power spectrum S falls as ``1 / f^2``, here scaled to a contrast of `SCENE_CONTRAST`. A frequency is
    resolved where ``|H|^2 S(f) >= noise^2``. One ring in ten below the result may fail. The maximum is 0.5, a period
    of two pixels.

    Args:
        psf: of unit sum.
        noise: standard deviation of the measurement's noise over its mean.

    References:
        D. J. Field, J. Opt. Soc. Am. A 4, 2379 (1987), for the spectra of photographs.
    """
    _, counts, frequency = _power(psf)
    falling = 1 / frequency.clamp(min=1e-9).square()
    falling[0, 0] = 0
    scale = SCENE_CONTRAST**2 / float(_mean(falling, counts))
    mean = radial_power(psf)
    visible = mean.power[1:] * scale / mean.frequency[1:].square() >= noise**2
    part = visible.float().cumsum(0) / torch.arange(1, len(visible) + 1)
    resolved = (visible & (part >= 0.9)).nonzero()
    return float(mean.frequency[1:][resolved[-1]]) if len(resolved) else 0.0
