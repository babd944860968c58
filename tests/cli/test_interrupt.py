"""Ctrl-C in real processes: one line that says how to go on, exit code 130, no traceback."""

import re
import shutil
import signal
import subprocess
import sys
from threading import Timer

import cv2
import numpy as np
import pytest

from mwdn.training.training_state import read_state

COPIES = 500
RECIPE = """
network = { name = "wiener-bank", width = 2, finest = 0, align = false }
schedule = { steps = 1000000, batch = 1, validate_every = 2, validation = 1, bfloat16 = false }
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Current folder with a PSF, 500 captures, photographs and a recipe."""
    monkeypatch.chdir(tmp_path)
    noise = np.random.default_rng(0)
    np.save("psf.npy", noise.random((32, 32, 3), np.float32) ** 9)
    for folder in ("captures", "photos"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(f"{folder}/0.png", noise.integers(0, 256, (32, 32, 3), np.uint8))
    for number in range(1, COPIES):
        shutil.copy("captures/0.png", f"captures/{number}.png")
    (tmp_path / "r.toml").write_text(RECIPE, encoding="utf-8")
    return tmp_path


def interrupted(line, sign):
    """Start a command, press Ctrl-C when a line with ``sign`` comes; returns the exit code and all output."""
    command = [sys.executable, "-m", "mwdn", *line.split(), "--psf", "psf.npy", "--device", "cpu"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        limit = Timer(120, process.kill)  # if the sign never comes
        limit.start()
        lines = []
        for text in process.stdout:
            lines.append(text)
            if sign in text:
                process.send_signal(signal.SIGINT)
                break
        lines += process.stdout
        limit.cancel()
    assert not any("Traceback" in text for text in lines)
    return process.returncode, lines


def test_reconstruct(here):
    code, lines = interrupted("reconstruct captures --method wiener -o out", " explains ")
    assert code == 130
    done = re.fullmatch(r"Interrupted: (\d+) of 500 captures (is|are) done\. .*--resume.*\n", lines[-1])
    assert 0 < int(done[1]) <= len(list((here / "out").glob("*.json"))) < COPIES


def test_train(here):
    code, lines = interrupted("train r.toml --photos photos -o run", "step 2: validation")
    assert code == 130
    step = re.fullmatch(r"Interrupted after step ([\d,]+)\. The same command resumes\.\n", lines[-1])
    state = here / "run" / "state.safetensors"
    assert read_state(state, state.read_bytes())[1]["step"] == step[1].replace(",", "")
