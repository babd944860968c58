"""The resolution at which a camera's captures should be reconstructed."""

from mwdn.calibration import Calibration
from mwdn.diagnosis.verdict import Verdict
from mwdn.optics import psf_measures


def coarsest_bin(calibration: Calibration) -> int:
    """Largest ``bin`` of PSF and captures that loses little, see `mwdn.optics.psf_measures.coarsest_bin`.

    Nothing is binned: ``Calibration.from_file(path, bin=coarsest_bin(calibration))``.
    """
    return calibration.frames.bin * psf_measures.coarsest_bin(calibration.psf)


def binning(calibration: Calibration) -> Verdict:
    """Whether PSF and captures can be binned: the state is always good, the value the ``bin``."""
    bin, line = coarsest_bin(calibration), psf_measures.autocorrelation(calibration.psf).width / 2**0.5
    if bin == calibration.frames.bin:
        text = f"The PSF's lines are {line:.1f} px wide: captures need not be binned."
        return Verdict("psf", "binning", "good", text, str(bin))
    text = f"The PSF's lines are {line:.0f} px wide, so binning loses little."
    return Verdict("psf", "binning", "good", text, str(bin), f"--bin {bin}")
