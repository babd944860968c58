"""Each field of a JSON document that a command writes, and each key of a session, is in the page that describes it."""

import re
from dataclasses import fields
from pathlib import Path

import pytest
import torch

from mwdn.calibration.report import Levels, PsfReport
from mwdn.capture.recipe import TABLES
from mwdn.diagnosis import Verdict
from mwdn.diagnosis.trust import examine_picture
from mwdn.evaluation.report import Report, Scores
from mwdn.optics import sample_camera
from mwdn.optics.psf_measures import Support

DOCS = Path(__file__).parents[1] / "docs"


def documented(page, heading=""):
    """Words in backticks from a heading to the next, or of the page."""
    text = (DOCS / page).read_text()
    text = text.partition(heading)[2].partition("\n## ")[0] if heading else text
    return set(re.findall(r"`(\w+)`", text))


@pytest.mark.parametrize("kind", [PsfReport, Levels, Support])
def test_inspect(kind):
    assert {field.name for field in fields(kind)} <= documented("inspect.md", "## JSON")


def test_evaluate():
    scores = Scores({"psnr": (20.0, 21.0)}, (0.1, 0.2), None, "cpu", 5)
    report = Report("full", "clipped", {"wiener": scores}, {}, [])
    content = report._content()
    assert {*content, *content["methods"]["wiener"]} <= documented("evaluate.md", "## JSON")


def test_reconstruct():
    psf = sample_camera(0, (40, 44))
    scene = torch.rand(psf.shape, generator=torch.Generator().manual_seed(0))
    numbers = examine_picture(scene, psf, scene).content
    assert {*numbers, "method", "psf_hash", "origin", "bin", "verdicts"} <= documented("reconstruct.md", "## Output")
    assert {field.name for field in fields(Verdict)} <= documented("troubleshooting.md")


@pytest.mark.parametrize("table", sorted(TABLES.keys() - {"rig"}))
def test_capture(table):
    """Keys such as `skip` and `most_s` were in no page."""
    assert {field.name for field in fields(TABLES[table])} <= documented("capture.md", "## A session")
