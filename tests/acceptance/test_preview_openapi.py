"""schemathesis: random requests, right and wrong, are answered as the OpenAPI document says."""

import importlib.util
import re
import subprocess
import sys

import pytest

from mwdn.calibration import Calibration
from mwdn.capture import open_source
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.live import Live
from mwdn.preview.server import make_server
from preview_server import LIMITS, SIDE

pytestmark = [
    pytest.mark.acceptance,
    pytest.mark.skipif(importlib.util.find_spec("schemathesis") is None, reason="pip install 'mwdn[acceptance]'"),
]
SEED = "1"
EXAMPLES = "30"


def test_answers_are_those_of_the_document(tmp_path):
    """All checks but one: that a valid request succeeds. No schema says which bytes are a picture of a point source."""
    rig = open_source(f"rig,height={SIDE},width={SIDE},fps=10,prepared=4")
    live = Live(rig, Calibration(rig.psf), method="wiener", folder=tmp_path, device="cpu")
    server = make_server(StoredCameras(LIMITS, tmp_path / "cameras"), LIMITS, device="cpu", live=live)
    server.start()
    try:
        line = [sys.executable, "-m", "schemathesis.cli", "run", f"{server.url}openapi.json"]
        line += ["--phases", "examples,coverage,fuzzing,stateful", "--max-examples", EXAMPLES, "--seed", SEED]
        line += ["--exclude-checks", "positive_data_acceptance", "--suppress-health-check", "all", "--no-color"]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=1200)
    finally:
        server.stop()
    print(done.stdout)
    assert done.returncode == 0, done.stdout[-6000:]
    assert int(re.search(r"(\d+) generated", done.stdout)[1]) > 200
