"""Binning that loses little."""

import pytest

from cameras import gaussian_psf
from mwdn import Calibration
from mwdn.calibration import FrameFormat
from mwdn.diagnosis import coarsest_bin
from mwdn.diagnosis.resolution import binning


@pytest.mark.parametrize(("sigma", "side", "expected"), [(1.0, 320, 1), (6.0, 320, 3), (6.0, 240, 2)])
def test_largest_bin_is_a_sixth_of_the_autocorrelation(sigma, side, expected):
    """Its width is 3.33 sigma less 10 %, for wide structure does not count; 100 pixels remain along each side."""
    assert coarsest_bin(Calibration(gaussian_psf((side, side), sigma))) == expected


def test_binned_psf_counts_from_the_frame():
    assert coarsest_bin(Calibration(gaussian_psf((320, 320), 6.0), FrameFormat(bin=2))) == 6


def test_verdict_has_the_option():
    wide, sharp = (binning(Calibration(gaussian_psf((320, 320), sigma))) for sigma in (6.0, 1.0))
    assert (wide.value, wide.options) == ("3", "--bin 3")
    assert (sharp.value, sharp.options) == ("1", "")
