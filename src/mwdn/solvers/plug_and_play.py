"""Iterations between what the sensor saw and what scenes look like, which a denoiser knows better than any formula."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.fourier import inverse_spectrum, spectrum
from mwdn.solvers.admm import posed
from mwdn.solvers.pyramid import QUIET, Explanation, brightness

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""A picture (B, C, H, W), whose brightest pixel is about 1, and its noise level (B, 1, 1, 1); the clean picture."""

LEVELS = 0.03, 0.005
"""Noise that the denoiser is told of, in the first round and in the last, over the scene's brightest pixel."""

TRUST = 0.1
"""Weight of the denoised scene, over that of a scene whose error is the denoiser's level: the best of 0.03 to 3 on 16
exact captures through four measured PSFs, where 0.07 and 0.15 cost 0.1 dB, but once 0.9."""

DATA = 0.3
"""mu of the sensor's crop; it changes the way, not the destination."""


def plug_and_play(found: Explanation, denoise: Denoiser, rounds: int) -> Explanation:
    """Explain the measurement by a scene that a denoiser would leave as it is.

    How far the measurement is trusted follows what ``found`` leaves unexplained of it: noise, or what the PSF does not
    say, which in real captures is more.

    Half-quadratic splitting: a scene near the denoised one that explains the measurement (two iterations of ADMM,
    which knows that the sensor crops the pattern), and this one denoised, by and by at a lower level.

    Args:
        found: where to begin, of a pyramid that reaches the full size. What lies beyond the frame is not denoised.
        denoise: see `Denoiser`.
        rounds: how many.

    References:
        K. Zhang et al., "Plug-and-play image restoration with deep denoiser prior", TPAMI 44 (2022).
    """
    band = found.psf.bands[-1]
    problem = posed(found.measurement.float(), band.transfer)
    grid, (height, width) = problem.grid, problem.sensor
    known = (found.whole * band.norm).expand(*found.measurement.shape[:2], *grid)
    brightest = known[..., :height, :width].amax((1, 2, 3), keepdim=True)
    brightest = brightest.clamp(min=torch.finfo(torch.float32).tiny)
    noise = torch.maximum(found.noise.clamp(min=QUIET) * brightness(found.measurement), brightness(found.rest))
    V, Hv = spectrum(known, grid), problem.measurement - found.rest
    xi = torch.zeros_like(Hv)  # the crop's multiplier, over its penalty
    first, last = LEVELS
    for step in range(rounds):
        level = torch.full_like(noise, first * (last / first) ** (step / max(1, rounds - 1)))
        trust = TRUST * (noise / (level * brightest)).square()
        quotient = 1 / (DATA * problem.power + trust)
        kept, gain = DATA * problem.power * quotient, DATA * quotient * problem.adjoint
        prior = spectrum(known, grid).mul_(trust * quotient)
        for _ in range(2):
            pull = (DATA * (xi + Hv) + problem.measurement) / (1 + DATA) - xi
            V = spectrum(pull - Hv, grid).mul_(gain).add_(prior).add_(V.mul_(kept))
            Hv = inverse_spectrum(problem.transfer * V, grid, problem.sensor)
            xi = Hv - pull
        free = inverse_spectrum(V, grid, grid).clamp(min=0)
        seen = free[..., :height, :width]
        clean = brightest * denoise(seen / brightest, level).clamp(min=0)
        known = free + F.pad(clean - seen, (0, grid[1] - width, 0, grid[0] - height))
    return replace(found, whole=known / band.norm)
