"""Turn, scale and shear PSFs about their centre; haze."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.types import Psf


def warp(psf: Psf, matrix: Tensor, shift: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """Map PSFs by 2 x 2 matrices of (row, column) displacements from their centre ``(h // 2, w // 2)``; bicubic.

    Args:
        psf: (1 or B, C, h, w). Its brightness is kept, so its sum changes with the matrix's determinant.
        matrix: (2, 2), or (B, 2, 2) for one of each PSF.
        shift: down and right, in pixels, after that.

    Returns:
        (B, C, h, w), not negative; darkness comes in from beyond the frame.
    """
    height, width = psf.shape[-2:]
    inverse = torch.linalg.inv(matrix.to(psf)).expand(max(len(psf), len(matrix.reshape(-1, 2, 2))), 2, 2)
    y = torch.arange(height, device=psf.device)[:, None] - height // 2 - shift[0]
    x = torch.arange(width, device=psf.device)[None] - width // 2 - shift[1]
    a, b, c, d = inverse.flatten(1).T[..., None, None]
    rows, columns = a * y + b * x + height // 2, c * y + d * x + width // 2
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], -1)
    psf = psf.expand(len(grid), -1, -1, -1)
    return F.grid_sample(psf, grid, mode="bicubic", align_corners=False).clamp(min=0)


def hazed(psf: Tensor, part: Tensor | float) -> Tensor:
    """Spread a part of the light of PSFs (..., h, w) evenly over them; ``part`` is a number or broadcasts."""
    return psf + part * (psf.mean((-2, -1), keepdim=True) - psf)
