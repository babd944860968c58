"""Plug-and-play half-quadratic splitting with a learned denoiser.

Minimises ``1/2 |C H v - b|^2 + R(z) + rho/2 |v - z|^2`` over scenes v and z alternately. H convolves with the PSF, C
crops to the sensor, b is the measurement, each pixel weighted by W (`certainty`), and R is defined by its denoiser:

1. v fits b near z. Because of C this is not a single division in the Fourier domain; one iteration of ADMM (penalty 1,
   as in `mwdn.solvers.splitting`, p the target on the sensor) approximates it:

   ``p = C H v + W / (1 + W) (b - (2 C H v - p))``, the difference at least 0 where b is saturated
   ``V = (|H|^2 V + conj(H) F(C^T (p - C H v)) + rho F(z)) / (|H|^2 + rho)``

2. ``z = denoise(max(v, 0), sigma)``, its noise level sigma lower in each round.

As in DPIR, ``rho = weight (noise / sigma)^2``: the prior has more weight for a noisier measurement and a cleaner z.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.runtime.iterations import iterations
from mwdn.solvers.levels import REFERENCE_NOISE, root_mean_square, smoothing_scale
from mwdn.solvers.pyramid import Estimate
from mwdn.solvers.splitting import Problem, deficit
from mwdn.types import TINY

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""From an image (B, C, H, W), whose brightest pixel is about 1, and its noise level (B, 1, 1, 1) to the clean image."""

NOISE_LEVELS = 0.03, 0.005
"""The denoiser's noise level in the first and in the last round, over the scene's brightest pixel, for little sensor
noise. From 0.05 on exact captures end 0.06 dB higher, but real ones, which their PSF fits less well, become soft."""

NOISE_EXPONENT = 0.6
"""Power of `smoothing_scale` by which `NOISE_LEVELS` grow: with the noise to the power 0.75. Worth 0.2 dB on 26 noisy
captures through random cameras."""

PRIOR_WEIGHT = 0.1
"""Weight in rho: the best of six from 0.03 to 1 on 16 exact captures through four measured PSFs. 0.07 and 0.14 cost
less than 0.1 dB, but 0.07 through one of the PSFs 0.35; 0.03 costs 0.4 to 4.7 dB through all."""


def plug_and_play(
    estimate: Estimate,
    denoise: Denoiser,
    rounds: int,
    *,
    noise_levels: tuple[float, float] = NOISE_LEVELS,
    noise_exponent: float = NOISE_EXPONENT,
    prior_weight: float = PRIOR_WEIGHT,
) -> Estimate:
    """Alternate between fitting the measurement and denoising the scene.

    The noise in rho is the larger of the sensor's and the root mean square residual of ``estimate``, which includes the
    errors of the PSF and is the larger one in real captures. Each round mirrors the scene another way before it is
    denoised, so that asymmetric errors of the denoiser do not accumulate.

    Args:
        estimate: the start, of a pyramid that reaches the full size. Only the part on the sensor is denoised.
        denoise: see `Denoiser`.
        rounds: number of rounds.
        noise_levels: see `NOISE_LEVELS`.
        noise_exponent: see `NOISE_EXPONENT`.
        prior_weight: see `PRIOR_WEIGHT`.

    References:
        K. Zhang et al., "Plug-and-play image restoration with deep denoiser prior", TPAMI 44 (2022).
    """
    band = estimate.psf.bands[-1]
    problem = Problem.from_transfer(estimate.measurement.float(), band.transfer, estimate.saturated)
    grid, (height, width) = problem.grid, problem.sensor
    z = (estimate.grid_scene * band.norm).expand(*estimate.measurement.shape[:2], *grid)
    brightest = z[..., :height, :width].amax((1, 2, 3), keepdim=True).clamp(min=TINY)
    sensor_noise = estimate.noise.clamp(min=REFERENCE_NOISE) * root_mean_square(estimate.measurement)
    noise = torch.maximum(sensor_noise, root_mean_square(estimate.residual))
    power = problem.transfer.abs().square()
    adjoint = problem.transfer.conj().resolve_conj()  # a lazy conjugate would be copied in each round
    V, Hv = spectrum(z, grid), problem.measurement - estimate.residual
    target, W = Hv, certainty(Hv)
    first, last = noise_levels
    scale = smoothing_scale(estimate.noise).clamp(min=1) ** noise_exponent
    for step in iterations(rounds, start=1.0):  # a server may cancel; the share of the work is not known here
        sigma = scale * first * (last / first) ** (step / max(1, rounds - 1))
        rho = prior_weight * (noise / (sigma * brightest)).square()
        target = deficit(problem, Hv, target).mul_(W / (1 + W)).add_(Hv)
        V = V.mul_(power).add_(spectrum(target - Hv, grid).mul_(adjoint))
        V = V.add_(spectrum(z, grid).mul_(rho)).mul_(1 / (power + rho))
        Hv = inverse_spectrum(problem.transfer * V, grid, problem.sensor)
        v = inverse_spectrum(V, grid, grid).clamp(min=0)
        image = v[..., :height, :width]
        axes = [axis for axis, bit in ((-1, 1), (-2, 2)) if step & bit]
        clean = brightest * denoise((image / brightest).flip(axes), sigma).flip(axes).clamp(min=0)
        z = v + F.pad(clean - image, (0, grid[1] - width, 0, grid[0] - height))
    return replace(estimate, grid_scene=z / band.norm)


def certainty(measurement: Tensor) -> Tensor:
    """Inverse noise variance of each pixel (B, C, H, W), scaled to mean 1 in each sample.

    Photon noise has a variance in proportion to the light; noise from other sources is taken to have as much as the
    photon noise of the mean.
    """
    mean = measurement.mean((1, 2, 3), keepdim=True).clamp(min=TINY)
    weight = mean / (measurement.clamp(min=0) + mean)
    return weight / weight.mean((1, 2, 3), keepdim=True)
