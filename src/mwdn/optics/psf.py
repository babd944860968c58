"""Identify, check and normalise PSFs."""

import hashlib

import torch
from torch import Tensor

from mwdn.arguments import check_batch
from mwdn.errors import PsfError
from mwdn.types import TINY, Psf

SUM_TOLERANCE = 1e-3
"""A PSF whose channels sum to 1 within this is used as it is: 1e-3 is a tenth of the step of 8-bit brightness."""


def psf_hash(psf: Psf) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a PSF's shape and float32 numbers."""
    digest = hashlib.sha256(repr(tuple(psf.shape)).encode())
    digest.update(psf.detach().float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def unit_sum(psf: Tensor) -> Tensor:
    """Divide each channel (..., h, w) by its sum: the camera then keeps the energy of the scene.

    Nothing is checked, see `mwdn.optics.psf.checked_psf`: a channel without light stays 0.
    """
    return psf / psf.sum((-2, -1), keepdim=True).clamp(min=TINY)


def checked_psf(psf: Tensor, *, values: bool = True, scale: bool = True) -> Psf:
    """Check a PSF and scale each channel to unit sum.

    The brightness of a captured PSF depends on its exposure, so only its shape counts, for every method alike. A PSF of
    unit sum is returned with the same numbers.

    Args:
        psf: (1 or B, C, h, w), light; of any scale.
        values: also check the numbers. The check waits for a GPU, so training leaves it out.
        scale: scale it; otherwise it is returned as it is.

    Raises:
        ShapeError: the axes are not those above.
        ParameterError: not a tensor of floats.
        PsfError: NaN, infinity, a negative number, or a channel without light.
    """
    check_batch(psf, "psf")
    total = psf.sum((-2, -1), keepdim=True, dtype=torch.promote_types(psf.dtype, torch.float32))
    if values and not torch.compiler.is_compiling() and psf.numel() > 0:  # a graph cannot depend on values
        _refuse_values(psf.detach(), total.detach())
    if not scale:
        return psf
    if not psf.requires_grad:  # otherwise the gradient needs the division
        total = torch.where((total - 1).abs() <= SUM_TOLERANCE, 1.0, total)
    return psf / total


def _refuse_values(psf: Tensor, total: Tensor) -> None:
    smallest = psf.amin()
    if bool((smallest >= 0) & (total > 0).all() & total.isfinite().all()):
        return
    if not psf.isfinite().all():
        raise PsfError("`psf` holds NaN or infinity. Capture it again.")
    raise PsfError(
        f"`psf` (smallest value {smallest:.3g}, smallest sum of a channel {total.min():.3g}) must not be negative, and "
        "must hold light in each channel. Subtract its background and clip it: `psf.clamp(min=0)`."
    )
