"""Rotate, scale and shear PSFs about their centre; add haze."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.types import Psf


def warp(psf: Psf, matrix: Tensor, shift: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """Warp PSFs about their centre ``(h // 2, w // 2)``: light at r = (row, column) moves to ``matrix r + shift``.

    Interpolation is bicubic.

    Args:
        psf: (1 or B, C, h, w). Brightness is kept, so the sum changes with the determinant of the matrix.
        matrix: (2, 2), or (B, 2, 2) with one for each PSF.
        shift: down and right, in pixels.

    Returns:
        (B, C, h, w), not negative; darkness enters from outside the frame.
    """
    height, width = psf.shape[-2:]
    inverse = torch.linalg.inv(matrix.to(psf)).expand(max(len(psf), len(matrix.reshape(-1, 2, 2))), 2, 2)
    y = torch.arange(height, device=psf.device, dtype=psf.dtype)[:, None] - height // 2 - shift[0]
    x = torch.arange(width, device=psf.device, dtype=psf.dtype)[None] - width // 2 - shift[1]
    a, b, c, d = inverse.flatten(1).T[..., None, None]
    rows, columns = a * y + b * x + height // 2, c * y + d * x + width // 2
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], -1)
    psf = psf.expand(len(grid), -1, -1, -1)
    return F.grid_sample(psf, grid, mode="bicubic", align_corners=False).clamp(min=0)


def hazed(psf: Tensor, part: Tensor | float) -> Tensor:
    """Spread a fraction of the light of PSFs (..., h, w) evenly over the frame; ``part`` is a number or broadcasts."""
    return psf + part * (psf.mean((-2, -1), keepdim=True) - psf)


def affine(turn: Tensor, scale_y: Tensor, scale_x: Tensor, shift: Tensor, aspect: float) -> Tensor:
    """(B, 2, 3) matrices for ``affine_grid`` that scale, then turn (clockwise), then shift the content of a picture.

    Args:
        turn: (B,), in radians.
        scale_y: (B,), vertical magnification of the content.
        scale_x: (B,), horizontal magnification.
        shift: (B, 2), down and right, in halves of the frame.
        aspect: width over height of the frame, so that a turned square stays a square.
    """
    c, s = turn.cos(), turn.sin()
    # affine_grid takes the inverse map, from output to input: unshift, turn back, then unscale.
    inverse = torch.stack(
        [
            torch.stack([c / scale_x, s / aspect / scale_x], -1),
            torch.stack([-s * aspect / scale_y, c / scale_y], -1),
        ],
        dim=1,
    )
    origin = -(inverse @ shift.flip(-1)[..., None])
    return torch.cat([inverse, origin], dim=-1)
