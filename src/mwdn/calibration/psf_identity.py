"""Which PSF pairs or weights belong to, by hashes in their metadata.

`mwdn calibrate --pairs` changes the PSF of a camera, and so its hash. Both hashes are stored, and either identifies it.
"""

from collections.abc import Mapping

from mwdn.calibration.psf import Calibration

_KEYS = ("psf_hash", "unrefined_psf_hash")


def psf_identity(calibration: Calibration) -> dict[str, str]:
    """Hash of the PSF, and of the PSF before a refinement if there is one, for metadata."""
    hashes = zip(_KEYS, (calibration.psf_hash, calibration.unrefined_hash), strict=True)
    return {key: value for key, value in hashes if value}


def other_psf(calibration: Calibration, metadata: Mapping[str, object]) -> str | None:
    """The hash in metadata if it is of another PSF than the calibration's, before or after a refinement of either."""
    named = [value for key in _KEYS if isinstance(value := metadata.get(key), str)]
    return named[0] if named and set(named).isdisjoint(psf_identity(calibration).values()) else None
