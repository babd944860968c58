"""What every PSF has: a hash that identifies it."""

import hashlib

from mwdn.types import Psf


def psf_hash(psf: Psf) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a PSF's shape and float32 numbers."""
    digest = hashlib.sha256(repr(tuple(psf.shape)).encode())
    digest.update(psf.float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
