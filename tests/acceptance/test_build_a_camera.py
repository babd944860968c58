"""The walk of docs/build-a-camera.md on the simulated rig, with real photographs."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.acceptance
SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "build_a_camera.py"


def test_from_nothing_to_a_trained_camera(data: Path, tmp_path: Path) -> None:
    """Half an hour on two cores. Pairs must not make the pictures worse; the scores are printed."""
    options = ("--counts", 10, "--held-out", 10, "--size", 128)
    words = [sys.executable, SCRIPT, data / "photos" / "test", tmp_path, *options]
    subprocess.run([*map(str, words)], check=True)
    scores = json.loads((tmp_path / "walk.json").read_text(encoding="utf-8"))
    assert scores.keys() == {"0 pairs", "10 pairs, camera refined", "10 pairs, network trained, too"}
    found = {
        name: {method: values["mean_low_high"]["psnr"][0] for method, values in report["methods"].items()}
        for name, report in scores.items()
    }
    print(json.dumps(found, indent=2))
    assert max(found["10 pairs, network trained, too"].values()) > found["0 pairs"]["universal"] - 0.2
    assert (tmp_path / "pictures" / "capture.png").is_file()
