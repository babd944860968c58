"""Checks of PSFs, captures and pictures: what may be wrong, and what to do about it."""

from mwdn.diagnosis.resolution import coarsest_bin
from mwdn.diagnosis.verdict import Verdict

__all__ = ["Verdict", "coarsest_bin"]
