"""Map of the parts of a picture that the capture supports.

With the residual r = d - H x of the capture's detail d, each part x_B of the picture x (its gain g fitted) is left out:

    Delta_B = |r + H x_B|^2 - |r|^2 = 2 <H^T r, x_B> + <x_B, H^T H x_B>
    support_B = Delta_B / (Delta_B + E_B),    E_B = n_B s^2

Delta_B is how much more of the detail would be unexplained. E_B is how much of the residual (noise and errors of the
PSF) a part could fit: s^2 is the residual's mean square after the matched filter H^T, relative to that of white noise
of variance 1, and n_B the number of degrees of freedom that the PSF resolves in a part. Support is 1 where the capture
requires the content of the picture, and 0 where it does not: an invented blob, or darkness.

All parts together cost one correlation and one small transform for each: within a part, H^T H is the PSF's
autocorrelation up to its size. Parts are Hann windows that overlap by half.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.fourier.convolution import convolve, correlate
from mwdn.fourier.transforms import column_counts, fast_length, inverse_spectrum, spectrum
from mwdn.solvers.alignment import fine_detail
from mwdn.types import TINY, Measurement, Psf, Scene, size_of

PARTS_PER_SIDE = 20
"""Parts along the shorter side of a picture."""


class Support(NamedTuple):
    """How far the capture supports each part of a picture.

    Args:
        map: (rows, columns), 0 to 1.
        light: part of the picture's light that is supported.
        area: part of the parts that hold light with a support of at least a half. A part holds light if it has at
            least a tenth of the light of the brightest part.
    """

    map: Tensor
    light: float
    area: float


@torch.inference_mode()
def support_map(measurement: Measurement, psf: Psf, scene: Scene) -> Support:
    """Estimate which parts of a picture the capture supports.

    Args:
        measurement: (1, C, H, W).
        psf: (1, 1 or C, H, W), centred, in its best pose.
        scene: (1, C, H, W), the reconstruction.
    """
    unit = measurement.abs().amax().clamp(min=TINY)
    d, psf = fine_detail(measurement.float() / unit), psf.float().expand(-1, measurement.shape[1], -1, -1)
    s = fine_detail(convolve(scene.float() / unit, psf))
    gain = ((s * d).sum((-2, -1), keepdim=True) / s.square().sum((-2, -1), keepdim=True).clamp(min=1e-30)).clamp(min=0)
    x, r, h = gain * scene.float() / unit, d - gain * s, fine_detail(psf)
    step = max(4, min(x.shape[-2:]) // PARTS_PER_SIDE)
    matched = correlate(r, h)
    parts, products = _parts(x, step), _parts(matched * x, step)
    nearby = _autocorrelation(h, 2 * step)
    energy = _energies(parts, nearby) * _seen(h, measurement, step).to(x)
    delta = (2 * products.sum((1, 2, 3)) + energy).clamp(min=0)
    support = delta / (delta + _error(matched, nearby, step) + 1e-30)
    light = parts.clamp(min=0).sum((1, 2, 3))
    lit = light >= 0.1 * light.max().clamp(min=1e-30)
    return Support(
        support.reshape(-(-x.shape[-2] // step), -1).cpu(),
        float((support * light).sum() / light.sum().clamp(min=1e-30)),
        float((support[lit] >= 0.5).float().mean()) if lit.any() else 0.0,
    )


def _parts(image: Tensor, step: int) -> Tensor:
    """Hann windows of ``2 step`` pixels around each block of ``step`` pixels: (parts, C, 2 step, 2 step)."""
    before = step // 2
    down, right = (-(-length // step) * step + step - before - length for length in image.shape[-2:])
    cut = F.unfold(F.pad(image, (before, right, before, down)), (2 * step, 2 * step), stride=step)
    fade = torch.sin(torch.pi * (torch.arange(2 * step, device=image.device) + 0.5) / (2 * step)).square()
    return cut[0].T.reshape(-1, image.shape[1], 2 * step, 2 * step) * fade[:, None] * fade


def _autocorrelation(h: Psf, reach: int) -> Tensor:
    """``sum_u h(u) h(u + lag)`` for lags from ``-reach`` to ``reach - 1``, lag 0 first: (1, C, 2 reach, 2 reach)."""
    grid = fast_length(2 * h.shape[-2] + 2 * reach), fast_length(2 * h.shape[-1] + 2 * reach)
    power = spectrum(h, grid).abs().square().to(torch.complex64)
    whole = inverse_spectrum(power, grid, grid)
    rows = torch.cat([whole[..., :reach, :], whole[..., -reach:, :]], -2)
    return torch.cat([rows[..., :reach], rows[..., -reach:]], -1)


def _energies(parts: Tensor, nearby: Tensor) -> Tensor:
    """``<x_B, H^T H x_B>`` of each part, (parts,)."""
    grid = size_of(nearby)
    counts = column_counts(grid[1], device=parts.device)
    power = spectrum(parts, grid).abs().square() * spectrum(nearby, grid).real * counts
    return power.sum((1, 2, 3)) / (grid[0] * grid[1])


def _seen(h: Psf, measurement: Measurement, step: int) -> Tensor:
    """Part of the detail of each part's light that lands on the sensor, (parts,)."""
    landed = correlate(torch.ones_like(measurement, dtype=torch.float32), h.square())
    landed = (landed / h.square().sum((-2, -1), keepdim=True).clamp(min=1e-30)).mean(1, keepdim=True)
    down, right = (-length % step for length in landed.shape[-2:])
    return F.avg_pool2d(F.pad(landed, (0, right, 0, down), mode="replicate"), step).flatten()


def _error(matched: Tensor, nearby: Tensor, step: int) -> Tensor:
    """E_B: white noise has ``matched^2 = nearby(0)``, and ``step^2 nearby(0)^2 / sum nearby^2`` degrees of freedom."""
    peak = nearby[0, :, 0, 0].clamp(min=1e-30)
    freedom = step**2 * peak.square() / nearby[0].square().sum((-2, -1)).clamp(min=1e-30)
    return (matched.square().mean((0, -2, -1)) / peak * freedom).sum()
