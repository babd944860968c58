"""Evidence against the PSF, for `mwdn.networks.wiener_bank`: the residual that the iterations leave."""

import torch
from torch import Tensor

from mwdn.networks.block_means import block_means
from mwdn.solvers.levels import REFERENCE_NOISE
from mwdn.solvers.pyramid import Estimate
from mwdn.types import Scene

DOUBT_BLOCKS = 4, 16
"""Sides in pixels of the blocks over which the residual is averaged to compare it with the noise."""

MAPS = 2 + len(DOUBT_BLOCKS)
"""Maps of `against_psf` beside the light: the place, the noise, and a doubt for each of `DOUBT_BLOCKS`."""

MAX_DOUBT = 20.0
"""Ten real captures of two cameras have 3 to 21 at a side of 16."""

BENIGN_DOUBT = 2.0, 5.0
"""The denoiser's input is 0 up to the first doubt, and the full value from the second on. Where the PSF is exact,
`mwdn.solvers.align` finds up to 2.5 % of haze, which causes doubts of 2 to 3. With these as its input, the denoiser
makes the scene too bright and loses 0.2 to 0.3 dB."""


def doubt_of_psf(estimate: Estimate) -> Tensor:
    """Doubt of the PSF, as an input of the denoiser, (B, 1, 1, 1): 0 for a right PSF, 3 at most.

    ``t log(d)``: d is the `Estimate.doubt` in the largest of `DOUBT_BLOCKS`; t rises from 0 to 1 between the two of
    `BENIGN_DOUBT`.
    """
    none, whole = BENIGN_DOUBT
    doubt = estimate.doubt(DOUBT_BLOCKS[-1]).clamp(1, MAX_DOUBT)
    return doubt.log() * ((doubt - none) / (whole - none)).clamp(0, 1)


def against_psf(estimate: Estimate, detail: Scene, block: int) -> Tensor:
    """Maps of evidence for and against the PSF: (B, C + 4, H, W).

    1. The back-projected residual, averaged over blocks: light that the estimate lacks, or has too much of.
    2. The squared distance from the middle, 1 in the corners: real cameras lose light there.
    3. ``log(n / n0)``: the noise n of the measurement over its root mean square, n0 = `REFERENCE_NOISE`.
    4. ``log(d)`` for each of `DOUBT_BLOCKS`, d = `Estimate.doubt`.

    Args:
        estimate: of the iterations.
        detail: first Wiener estimate of its residual, (B, C, H, W).
        block: side of the blocks in pixels.
    """
    noise = estimate.noise.clamp(min=REFERENCE_NOISE / 10)
    doubts = [estimate.doubt(side).clamp(max=MAX_DOUBT) for side in DOUBT_BLOCKS]
    numbers = [(value + 1e-3).log() for value in (noise / REFERENCE_NOISE, *doubts)]
    size = detail.shape[-2:]
    y, x = (torch.linspace(-1, 1, length, device=detail.device, dtype=detail.dtype).square() / 2 for length in size)
    maps = [(y[:, None] + x).expand(detail.shape[0], 1, -1, -1), *(number.expand(-1, -1, *size) for number in numbers)]
    return torch.cat([block_means(detail, block), *maps], dim=1)
