"""From raw frames to a PSF that one can trust."""

from mwdn.calibration.psf import Calibration

__all__ = ["Calibration"]
