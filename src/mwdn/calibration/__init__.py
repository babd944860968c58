"""From raw frames to a PSF, and from captures to measurements."""

from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.psf import Calibration
from mwdn.calibration.psf_format import PsfFormat

__all__ = ["Calibration", "FrameFormat", "PsfFormat"]
