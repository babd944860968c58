"""The light over a camera's aperture: displaced envelope, uneven gain, wide tails of scattered light."""

import math

import torch
from torch import Tensor

from mwdn.fourier.transforms import fast_length, frequency_grid, inverse_spectrum, spectrum
from mwdn.optics.field import gaussian_blur
from mwdn.optics.warp import warp
from mwdn.types import Psf, Size, size_of

ENVELOPE_BLUR = 0.04
"""Standard deviation of the blur that leaves a PSF's envelope, over the shorter side of the frame: 13 pixels of 320,
the distance of the lines of the paper's PSF."""

MIN_ENVELOPE = 0.1
"""Fraction of the envelope's maximum below which the PSF is not brightened: the pattern is too uncertain there."""


def displaced_envelope(psf: Psf, shift: Tensor, *, blur: float = ENVELOPE_BLUR) -> Psf:
    """Displace the aperture's shadow against the mask's pattern.

    A PSF is pattern x envelope, h = p E. The mask is at the distance d_m in front of the sensor, the aperture's edge at
    d_a. Light from the angle t displaces the pattern by d_m tan t and the shadow of the edge by d_a tan t, so the
    envelope moves by (d_a - d_m) tan t relative to the pattern. E is unknown; a wide Gaussian blur of h estimates it.
    The new PSF is h E(r - shift) / E(r), regularised like a Wiener filter: where E is dark the PSF stays as it is.

    Args:
        psf: (B, C, h, w).
        shift: (B, 2), of the envelope, down and right, in pixels.
        blur: see `ENVELOPE_BLUR`. A narrow blur leaves the pattern's lines in the envelope, a wide one blurs the
            envelope's edge.

    Returns:
        (B, C, h, w). The sum changes: it is the light that passes the displaced aperture.
    """
    envelope = gaussian_blur(psf, blur * min(psf.shape[-2:])).clamp(min=0)
    moved = [
        warp(one[None], torch.eye(2), (down, right))
        for one, (down, right) in zip(envelope, shift.tolist(), strict=True)
    ]
    floor = (MIN_ENVELOPE * envelope.amax((-2, -1), keepdim=True)).square().clamp(min=1e-30)
    return psf * (torch.cat(moved) * envelope + floor) / (envelope.square() + floor)


def scattered(psf: Psf, part: Tensor, radius: Tensor) -> Psf:
    """Scatter a part of the light widely: ``(1 - part) h + part (k * h)``.

    Rough surfaces and reflections between sensor and mask give tails that fall as a power of the distance, not as a
    Gaussian. The kernel is the Cauchy distribution of the plane, ``k(r) = R / (2 pi (r^2 + R^2)^(3/2))``, whose
    transfer function is ``exp(-2 pi R |f|)``: half of the light falls beyond r = sqrt(3) R.

    Args:
        psf: (B, C, h, w).
        part: (B, 1, 1, 1), fraction of the light that is scattered.
        radius: (B, 1, 1, 1), R in pixels.

    Returns:
        (B, C, h, w). Light scattered beyond the frame is lost.

    References:
        J. E. Harvey, Appl. Opt. 51, 3 (2012): scattering by polished surfaces falls as a power of the angle.
    """
    size = size_of(psf)
    grid = fast_length(2 * size[0]), fast_length(2 * size[1])  # no circular wrap-around
    rows, columns = frequency_grid(grid, device=psf.device)
    transfer = torch.exp(-2 * math.pi * radius * (rows.square() + columns.square()).sqrt())
    return (1 - part) * psf + part * inverse_spectrum(spectrum(psf, grid) * transfer, grid, size).clamp(min=0)


def low_order_field(coefficients: Tensor, size: Size) -> Tensor:
    """Smooth field of largest magnitude 1: a sum of products of cosines, the lowest terms of a DCT.

    Args:
        coefficients: (..., n, n); row j and column k is the weight of ``cos(pi j y) cos(pi k x)``, y and x from 0 to 1.
            The constant term (0, 0) is ignored.
        size: height and width of the field.

    Returns:
        (..., height, width).
    """
    order = torch.arange(coefficients.shape[-1], device=coefficients.device)
    weights = coefficients.clone()
    weights[..., 0, 0] = 0
    y, x = (torch.cos(math.pi * order * (torch.arange(n, device=coefficients.device)[:, None] + 0.5) / n) for n in size)
    field = y @ weights @ x.T
    return field / field.abs().amax((-2, -1), keepdim=True).clamp(min=1e-12)
