"""Alignment on real captures: the pictures go to results/acceptance/align; look at them."""

import json
from pathlib import Path

import numpy as np
import pytest

from mwdn.registration import Place, Projection

pytestmark = pytest.mark.acceptance
OUT = Path("results/acceptance/align")


@pytest.mark.parametrize("method", ["universal", "admm"])
def test_the_display_of_the_papers_camera_is_found(data: Path, run, method: str) -> None:
    """A square of 130 px, seen a little from the side, whichever method reconstructs.

    By hand, in the Wiener estimate minus its blur, with profiles 8 px wide across each side: corners (175.5, 158.6),
    (303.9, 160.9), (305.2, 288.2), (174.0, 291.4), scattered by 0.1 px, alike in red, green and blue within 0.3 px.
    Every method with positive light cuts the uppermost 12 px, which are dark. The data's README has about 137 x 137 px
    at (168, 168), turned by -1.3 degrees: the lower side's turn, and a rectangle that takes in artefacts below it.
    """
    camera = data / "mwdn-camera"
    out = OUT / method
    files = (camera / "display_capture.tif", "--psf", camera / "psf_480.tif")
    status, said, _ = run("align", *files, "--method", method, "-o", out)
    assert status == 0
    assert "turned by" in said
    projection = Projection.from_dict(json.loads((out / "display_capture.align.json").read_text()))
    corners = projection.corners()
    assert corners == pytest.approx(np.array([[175.5, 158.6], [303.9, 160.9], [305.2, 288.2], [174.0, 291.4]]), abs=1)
    place = Place.of(corners)
    assert (place.width, place.height) == pytest.approx((130, 130), abs=1)
    assert place.turn_degrees == pytest.approx(-0.2, abs=0.3)
