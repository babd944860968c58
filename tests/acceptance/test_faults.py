"""Folders that cannot be written to, memory that ends, and SIGKILL while frames are recorded.

The commands of a test run in one process of its own, which has lost the right to write everywhere, or its memory.
Full disks and kills of other commands: `tests/io/test_full_disk.py`, `test_kills.py`, `tests/capture/test_session.py`.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from mwdn.capture.recording import Replay

pytestmark = pytest.mark.acceptance
KILLS = int(os.environ.get("MWDN_KILLS", "20"))

COMMANDS = {
    "reconstruct": "reconstruct capture.npy --psf psf.npy --background 0 --method admm --device cpu --out OUT",
    "simulate": "simulate photos --psf psf.npy --background 0 --count 2 --out OUT/pairs.h5",
    "train": "train r.toml --psf psf.npy --background 0 --photos photos --device cpu --out OUT/run",
    "benchmark": "benchmark b.toml --no-lpips --device cpu --out OUT/benchmark",
    "design": "design contour --out OUT/mask",
    "inspect": "inspect psf.npy --background 0 --out OUT/report",
    "export": "export wiener --psf psf.npy --background 0 --out OUT/camera.onnx",
    "calibrate": "calibrate psf.npy --background 0 --out OUT/camera.toml",
    "demo": "demo --pictures cat --out OUT/demo",
}
"""Every command that writes, with small inputs."""

RECIPE = 'network = { name = "wiener" }\nschedule = { steps = 2, batch = 1, validate_every = 1, validation = 1 }\n'
BENCHMARK = """
solvers = { wiener = {} }
shared.data = { photos = "photos", test_photos = "test", background = 0.0 }
[data]
a = { psf = "psf.npy", train = 1, validation = 1, test = 1 }
"""

RUN = """
import contextlib, io, json, resource, sys
from pathlib import Path
import torch
from mwdn.cli.app import main

megabytes, *lines = sys.argv[1:]
if int(megabytes):
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + int(megabytes) * 2**20,) * 2)
for line in lines:
    out, err, code = io.StringIO(), io.StringIO(), 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main(line.split())
    except SystemExit as ended:
        code = ended.code or 0
    print(json.dumps([line.split()[0], code, err.getvalue()]), flush=True)
"""


@pytest.fixture
def here(tmp_path):
    """Inputs of the commands, and a folder ``out``."""
    noise = np.random.default_rng(34)
    np.save(tmp_path / "psf.npy", noise.random((32, 40, 3), np.float32) ** 9)
    np.save(tmp_path / "capture.npy", noise.random((32, 40, 3), np.float32))
    for number, folder in enumerate(("photos", "photos", "photos", "test")):
        (tmp_path / folder).mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / folder / f"{number}.png"), noise.integers(0, 256, (32, 32, 3), np.uint8))
    (tmp_path / "r.toml").write_text(RECIPE)
    (tmp_path / "b.toml").write_text(BENCHMARK)
    (tmp_path / "out").mkdir()
    return tmp_path


def run(folder, *lines, megabytes=0, before=()):
    """Name, exit status and standard error of each command."""
    call = [*before, sys.executable, "-c", RUN, str(megabytes), *lines]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.skipif(not shutil.which("setpriv"), reason="root may write everywhere, and setpriv is missing")
def test_folders_that_cannot_be_written_to(here):
    """One line that names the folder, status 2, and nothing is written."""
    (here / "out").chmod(0o500)
    without = ("setpriv", "--bounding-set", "-dac_override", "--inh-caps", "-dac_override") if os.geteuid() == 0 else ()
    lines = [line.replace("OUT", "out") for line in COMMANDS.values()]
    for name, code, err in run(here, *lines, before=without):
        assert (code, len(err.splitlines())) == (2, 1), (name, code, err)
        assert err.startswith("Error: "), (name, err)
        assert "out" in err, (name, err)
        assert "Permission denied" in err or "permission" in err, (name, err)
    (here / "out").chmod(0o700)
    assert list((here / "out").iterdir()) == []
    print(f"{len(lines)} commands, read-only")


def test_memory_that_ends(here):
    """A capture, a PSF and photographs that need more than there is: an error without a traceback, no file in part."""
    large = np.random.default_rng(0).random((3000, 4000, 3), np.float32)
    np.save(here / "capture.npy", large)
    np.save(here / "psf.npy", large**9)
    commands = {name: COMMANDS[name] for name in ("reconstruct", "simulate", "train", "inspect", "calibrate", "export")}
    lines = [line.replace("OUT", "out") for line in commands.values()]
    for name, code, err in run(here, *lines, megabytes=120):
        assert code in (1, 2), (name, code, err)
        assert "Traceback" not in err, (name, err)
        assert "memory" in err, (name, err)
    visible = [path for path in (here / "out").rglob("*") if path.is_file() and not path.name.startswith(".")]
    assert visible == []
    print(f"{len(lines)} commands, out of memory")


RECORD = """
import sys, numpy as np
from mwdn.capture.recording import record
from mwdn.capture.source import CameraFrame
with record(sys.argv[1]) as recorder:
    for number in range(100_000):
        array = np.full((48, 64, 1), number % 4096, np.uint16)
        recorder.append(CameraFrame(array=array, bit_depth=12, timestamp=float(number), number=number))
        print(number, flush=True)
"""


def test_a_recording_keeps_each_frame_that_was_acknowledged(tmp_path):
    generator, kept = random.Random(34), 0
    for kill in range(KILLS):
        path = tmp_path / f"{kill}.h5"
        process = subprocess.Popen([sys.executable, "-c", RECORD, str(path)], stdout=subprocess.PIPE, text=True)
        process.stdout.readline()
        time.sleep(generator.uniform(0, 0.3))
        process.send_signal(signal.SIGKILL)
        said = [0, *map(int, process.communicate()[0].split())]
        with Replay(path) as camera:
            frames = [camera.read() for _ in range(len(camera._data))]
        assert len(frames) - max(said) - 1 in (0, 1)  # one may be on the disk before it is said
        assert all((frame.array == number % 4096).all() for number, frame in enumerate(frames))
        kept += len(frames)
    print(f"{KILLS} kills of a recording, {kept:,} frames, none lost")
