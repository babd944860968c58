"""What may be wrong with a PSF, a capture or a picture, and what to do about it."""

from mwdn.diagnosis.resolution import coarsest_bin
from mwdn.diagnosis.verdict import Verdict

__all__ = ["Verdict", "coarsest_bin"]
