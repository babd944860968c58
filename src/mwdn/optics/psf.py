"""Identify and normalise PSFs."""

import hashlib

from torch import Tensor

from mwdn.types import Psf


def psf_hash(psf: Psf) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a PSF's shape and float32 numbers."""
    digest = hashlib.sha256(repr(tuple(psf.shape)).encode())
    digest.update(psf.float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def unit_sum(psf: Tensor) -> Tensor:
    """Divide each channel (..., h, w) by its sum: the camera then keeps the energy of the scene."""
    return psf / psf.sum((-2, -1), keepdim=True)
