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


def affine(turn: Tensor, scale_y: Tensor, scale_x: Tensor, shift: Tensor, aspect: float) -> Tensor:
    """(B, 2, 3) matrices for ``affine_grid`` that scale, then turn (clockwise), then shift a picture's content.

    Args:
        turn: (B,), radian.
        scale_y: (B,), height of the content over that of the frame.
        scale_x: (B,), width of the content over that of the frame.
        shift: (B, 2), down and right, over half the frame.
        aspect: width over height of the frame, so that a turned square stays a square.
    """
    c, s = turn.cos(), turn.sin()
    # affine_grid asks where each output pixel comes from: the inverse map, undone from the outside in.
    inverse = torch.stack(
        [
            torch.stack([c / scale_x, s / aspect / scale_x], -1),
            torch.stack([-s * aspect / scale_y, c / scale_y], -1),
        ],
        dim=1,
    )
    origin = -(inverse @ shift.flip(-1)[..., None])
    return torch.cat([inverse, origin], dim=-1)
