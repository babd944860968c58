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
    """Its published place is about 137 x 137 px at (168, 168), turned by -1.3 degrees.

    What a reconstruction shows lies within: its sides are 129 (or 131) and 117 (or 120) px long, and both
    reconstructions agree on the corners within 5 px. The lower side is turned by -1.2 (or -1.8) degrees, the upper not.
    """
    camera = data / "mwdn-camera"
    out = OUT / method
    files = (camera / "display_capture.tif", "--psf", camera / "psf_480.tif")
    status, said, _ = run("align", *files, "--method", method, "-o", out)
    assert status == 0
    assert "turned by" in said
    projection = Projection.from_dict(json.loads((out / "display_capture.align.json").read_text()))
    corners = projection.corners()
    assert corners == pytest.approx(np.array([[175.5, 172], [304.5, 173], [305, 289], [175, 292]]), abs=3.5)
    place = Place.of(corners)
    assert (place.left, place.top, place.width, place.height) == pytest.approx((168, 168, 137, 137), abs=20.5)
    assert -1.8 < place.turn_degrees < 0
