"""Errors name the fields of the HTTP interface."""

import numpy as np
import pytest

from mwdn.preview.as_fields import as_fields
from preview_server import SIDE, npy

EXAMPLES = {
    "Use both as grey: `grey=True`.": 'Use both as grey: `calibration={"grey": true}`.',
    "Try `--bin 2 --psf-bin 2`.": 'Try `calibration={"bin": 2, "psf_bin": 2}`.',
    "Crop: `crop=(45, 45)`.": 'Crop: `calibration={"crop": [45, 45]}`.',
    "Give `mosaic='rggb'`.": 'Give `calibration={"mosaic": "rggb"}`.',
    "Try `--gamma srgb`.": 'Try `calibration={"gamma": "srgb"}`.',
    "See `--gamma`.": "See `gamma`.",
    "See `--iterations`.": "See `iterations`.",
    "Try `iterations=50`.": 'Try `options={"iterations": 50}`.',
    "Gains: `white_balance=(1.8, 1, 1.5)`.": "Gains: `white_balance=1.8,1,1.5`.",
    "Try `--ambient FILE`, `--align`.": "Try `ambient=@FILE`, `align=true`.",
    "`bin` ('2') of `FrameFormat` must be whole.": "`bin` ('2') of `calibration` must be whole.",
    **{same: same for same in ("`bin=`, `f=(`", "`--flat a.png`", "`mwdn explain size`", "`x=1`", "`--dark`")},
    # Text of a client, which the error repeats.
    **{same: same for same in ("`bin={1,2}`", "`--bin 4 --`", f"`x={'-' * 5000}1`", f"`bin={'(' * 5000}`")},
}


@pytest.mark.parametrize("message", EXAMPLES)
def test_arguments_and_options_become_fields(message):
    assert as_fields(message) == EXAMPLES[message]


def test_answers_and_jobs_name_fields(client, capture, psf_file):
    files = {"capture": npy(np.ones((SIDE // 2, SIDE // 2, 3), np.uint16)), "psf": psf_file}
    answer = client.post("/reconstruct", files=files, data={"method": "wiener"})
    place = client.post("/jobs", files=files, data={"method": "wiener"}).headers["location"]
    while (job := client.get(place).json())["state"] not in ("done", "failed"):
        pass
    assert answer.json()["error"] == job["error"]
    assert 'calibration={"psf_bin": 2}' in job["error"]


def test_a_name_of_a_client_is_refused_whatever_it_is(client):
    """Some of them, read as arguments of Python, ended in an error of the server itself."""
    assert client.get("/cameras/`bin={1,2}`").status_code == 404
