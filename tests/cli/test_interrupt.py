"""Ctrl-C, SIGTERM and closed pipes in real processes: one line that says how to go on, no traceback."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from threading import Timer

import cv2
import numpy as np
import pytest

from mwdn.training.training_state import read_state

FULL = Path("/dev/full")
COPIES = 100
RECIPE = """
network = { name = "wiener" }
schedule = { steps = 1000000, batch = 1, validate_every = 2, validation = 1, bfloat16 = false }
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Current folder with a PSF, `COPIES` captures, photographs and a recipe."""
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


def interrupted(line, sign, number=signal.SIGINT):
    """Start a command, send a signal when a line with ``sign`` comes; returns the exit code and all output."""
    command = [sys.executable, "-m", "mwdn", *line.split(), "--psf", "psf.npy", "--device", "cpu"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        limit = Timer(120, process.kill)  # if the sign never comes
        limit.start()
        lines = []
        for text in process.stdout:
            lines.append(text)
            if sign in text:
                process.send_signal(number)
                break
        lines += process.stdout
        limit.cancel()
    assert not any("Traceback" in text for text in lines)
    return process.returncode, lines


def test_reconstruct(here):
    code, lines = interrupted("reconstruct captures --method wiener -o out", " saturated")
    assert code == 130
    done = re.fullmatch(rf"Interrupted: (\d+) of {COPIES} captures (is|are) done\. .*--resume.*\n", lines[-1])
    assert 0 < int(done[1]) <= len(list((here / "out").glob("*.json"))) < COPIES


def test_train(here):
    """Batch systems send SIGTERM some seconds before they kill."""
    code, lines = interrupted("train r.toml --photos photos -o run", "step 2: validation", signal.SIGTERM)
    assert code == 143
    step = re.fullmatch(r"Interrupted after step ([\d,]+)\. The same command resumes\.\n", lines[-1])
    state = here / "run" / "state.safetensors"
    assert read_state(state, state.read_bytes())[1]["step"] == step[1].replace(",", "")


@pytest.mark.parametrize(
    ("number", "error", "line", "code", "message"),
    [
        (signal.SIGINT, None, "train a.toml", 130, "What is saved is kept. The same command resumes."),
        (signal.SIGTERM, None, "reconstruct a.png", 143, "The same command with --resume goes on."),
        (signal.SIGTERM, "ExportError('cannot be exported')", "export admm", 143, "The same command starts again."),
        (signal.SIGTERM, None, "reconstruct --help", 143, "Interrupted."),  # it promised finished pictures
    ],
)
def test_while_modules_are_imported(number, error, line, code, message):
    """`exec`, as dataclasses use it: Python ended by SIGINT itself. Errors that torch makes of Ctrl-C were printed."""
    begin = f"""
import signal
from mwdn.cli import app, main
from mwdn.errors import ExportError
def import_module(name):
    try: exec("signal.raise_signal({int(number)})")
    except KeyboardInterrupt as interrupt: raise {error or "interrupt"}
app.import_module = import_module
main({line.split()})
"""
    done = subprocess.run([sys.executable, "-c", begin], capture_output=True, text=True, check=False, timeout=600)
    assert (done.returncode, len(done.stderr.splitlines())) == (code, 1)
    assert done.stderr.startswith("Interrupted.")
    assert done.stderr.endswith(f"{message}\n")


@pytest.mark.parametrize("line", ["recipes quick-cpu", "--help", "nonsense"])
def test_nobody_reads_the_output(line):
    """As in `mwdn recipes quick-cpu | head -1`: status 141, which shells report for SIGPIPE, and no traceback."""
    closed, pipe = os.pipe()
    os.close(closed)
    command = [sys.executable, "-m", "mwdn", *line.split()]
    wrong = line == "nonsense"  # the error goes to a closed pipe
    done = subprocess.run(
        command, stdout=pipe, stderr=pipe if wrong else subprocess.PIPE, text=True, check=False, timeout=600
    )
    os.close(pipe)
    assert (done.returncode, done.stderr or "") == (141, "")


@pytest.mark.parametrize("line", ["recipes quick-cpu", "--version"])
@pytest.mark.skipif(not FULL.exists(), reason="Linux has a device that is always full")
def test_no_room_for_the_output(line):
    """As in `mwdn recipes quick-cpu > mine.toml` on a full disk, which ended in a traceback and left half a file."""
    with FULL.open("w") as full:
        command = [sys.executable, "-m", "mwdn", *line.split()]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=600)
    message = "Error: The output cannot be written: No space left on device. Make room.\n"
    assert (done.returncode, done.stderr) == (2, message)
