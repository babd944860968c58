"""Captures and PSFs of a phone, whose pixels a program has turned, or not."""

import numpy as np
import pytest
from PIL import Image, ImageOps

from mwdn.diagnosis import Verdict
from mwdn.diagnosis.exif import exif_turn, settle_exif


@pytest.mark.parametrize("number", range(1, 9))
def test_equal_tags_are_no_doubt(number):
    assert exif_turn(number, number).state == "good"


@pytest.mark.parametrize("number", range(2, 9))
def test_the_turn_makes_a_psf_fit_whose_pixels_were_turned(number):
    """A phone stores two equal frames; a program shows one upright and saves it."""
    sensor = np.arange(12, dtype=np.uint8).reshape(3, 4)
    stored = Image.fromarray(sensor)
    stored.getexif()[274] = number
    saved = ImageOps.exif_transpose(stored)
    turn = {name.lower().replace("_", "-"): number for name, number in Image.Transpose.__members__.items()}

    verdict = exif_turn(number, 1)  # the PSF was saved again
    assert (verdict.state, verdict.options) == ("doubt", f"--psf-orientation {verdict.value}")
    np.testing.assert_array_equal(saved.transpose(turn[verdict.value]), sensor)

    verdict = exif_turn(1, number)  # the capture was
    np.testing.assert_array_equal(Image.fromarray(sensor).transpose(turn[verdict.value]), saved)


def test_two_other_tags_name_no_turn():
    verdict = exif_turn(6, 8)
    assert (verdict.state, verdict.value, verdict.options) == ("doubt", "", "")
    assert "a program has turned" not in verdict.text  # it would have reset the tag to 1


def test_the_capture_itself_settles_the_doubt():
    doubt, equal, fits = exif_turn(6, 1), exif_turn(6, 6), Verdict("psf", "orientation", "good", "The PSF fits.")
    cannot_tell = Verdict("psf", "orientation", "unknown", "Too much noise.")
    assert settle_exif((doubt, fits)) == (fits,)
    assert settle_exif((equal, fits)) == (equal, fits)
    assert settle_exif((doubt, cannot_tell)) == (doubt, cannot_tell)
