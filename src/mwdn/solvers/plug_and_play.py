"""Iterations between what the sensor saw and what scenes look like, which a denoiser knows better than any formula."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.solvers.pyramid import QUIET, Estimate, brightness, smoothing_scale
from mwdn.solvers.splitting import Problem, reflected

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""A picture (B, C, H, W), whose brightest pixel is about 1, and its noise level (B, 1, 1, 1); the clean picture."""

LEVELS = 0.03, 0.005
"""Noise that the denoiser is told of, in the first round and in the last, over the scene's brightest pixel, in good
light. From 0.05 on exact captures end 0.06 dB higher, but real ones, which their PSF explains less well, come out
soft."""

POOR = 0.6
"""Power of the caution that the noise asks for with which `LEVELS` grow in poor light: with the noise to the power
0.75. So plug and play ends 0.2 dB higher (26 captures in poor light through random cameras)."""

TRUST = 0.1
"""Weight of the denoised scene, over that of a scene whose error is the denoiser's level: the best of six from 0.03 to
1 on 16 exact captures through four measured PSFs. 0.07 and 0.14 cost less than 0.1 dB, but 0.07 through one of them
0.35, and 0.03 everywhere 0.4 to 4.7."""


def plug_and_play(found: Estimate, denoise: Denoiser, rounds: int) -> Estimate:
    """Explain the measurement by a scene that a denoiser would leave as it is.

    How far the measurement is trusted follows what ``found`` leaves unexplained of it: noise, or what the PSF does not
    say, which in real captures is more.

    Half-quadratic splitting: a scene near the denoised one that explains the measurement (an iteration of ADMM, which
    knows that the sensor crops the pattern), and this one denoised, by and by at a lower level. Each round shows it to
    the denoiser mirrored another way, so that what it does to one side of everything does not add up. Light is counted,
    so the noise of a pixel grows with it, and a dark pixel says more.

    Args:
        found: where to begin, of a pyramid that reaches the full size. What lies beyond the frame is not denoised.
        denoise: see `Denoiser`.
        rounds: how many.

    References:
        K. Zhang et al., "Plug-and-play image restoration with deep denoiser prior", TPAMI 44 (2022).
    """
    band = found.psf.bands[-1]
    problem = Problem.from_transfer(found.measurement.float(), band.transfer)
    grid, (height, width) = problem.grid, problem.sensor
    known = (found.whole * band.norm).expand(*found.measurement.shape[:2], *grid)
    brightest = known[..., :height, :width].amax((1, 2, 3), keepdim=True)
    brightest = brightest.clamp(min=torch.finfo(torch.float32).tiny)
    noise = torch.maximum(found.noise.clamp(min=QUIET) * brightness(found.measurement), brightness(found.residual))
    power = problem.transfer.abs().square()
    adjoint = problem.transfer.conj().resolve_conj()  # a lazy conjugate would be copied in each round
    V, Hv = spectrum(known, grid), problem.measurement - found.residual
    pull, certain = Hv, certainty(Hv)
    first, last = LEVELS
    poor = smoothing_scale(found.noise).clamp(min=1) ** POOR
    for step in range(rounds):
        level = poor * first * (last / first) ** (step / max(1, rounds - 1))
        trust = TRUST * (noise / (level * brightest)).square()
        pull = reflected(Hv, pull).add_(problem.measurement).mul_(certain / (1 + certain)).add_(Hv)
        V = V.mul_(power).add_(spectrum(pull - Hv, grid).mul_(adjoint))
        V = V.add_(spectrum(known, grid).mul_(trust)).mul_(1 / (power + trust))
        Hv = inverse_spectrum(problem.transfer * V, grid, problem.sensor)
        free = inverse_spectrum(V, grid, grid).clamp(min=0)
        seen = free[..., :height, :width]
        mirror = [axis for axis, turn in ((-1, 1), (-2, 2)) if step & turn]
        clean = brightest * denoise((seen / brightest).flip(mirror), level).flip(mirror).clamp(min=0)
        known = free + F.pad(clean - seen, (0, grid[1] - width, 0, grid[0] - height))
    return replace(found, whole=known / band.norm)


def certainty(light: Tensor) -> Tensor:
    """Weight of each pixel of a pattern (B, C, H, W), 1 on the mean of a sample.

    The variance of its noise grows with its light; as much as the mean light's comes from elsewhere.
    """
    mean = light.mean((1, 2, 3), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
    weight = mean / (light.clamp(min=0) + mean)
    return weight / weight.mean((1, 2, 3), keepdim=True)
