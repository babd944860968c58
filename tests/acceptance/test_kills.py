"""SIGKILL at random moments, again and again: no visible file is ever in part, and the end is as if nothing happened.

MWDN_KILLS is the number of kills of each command (default 20: 100 in all, about ten minutes).
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from safetensors.torch import load_file

from mwdn.io.images import read_frame
from runs import same

pytestmark = pytest.mark.acceptance
KILLS = int(os.environ.get("MWDN_KILLS", "20"))

TRAINING = """
network = { name = "wiener-bank", width = 4, regularisations = [1e-2, 1e-4], finest = 0, align = false }
schedule = { steps = 40, batch = 1, warmup = 2, ema = 0.9, validate_every = 7, validation = 2 }
"""
BENCHMARK = """
title = "Killed"
networks = { wiener = {}, mwdn = {} }
solvers = { quick = { name = "admm", iterations = 3 } }
shared.network = { width = 2 }
schedule = { steps = 6, batch = 2, validate_every = 2, warmup = 0, bfloat16 = false }
shared.data = { photos = "DATA/photos/test", test_photos = "others" }
[data]
camera = { psf = "DATA/mwdn-camera/psf_320.png", bin = 5, train = 8, validation = 2, test = 3 }
"""
COMMANDS = {
    "train": "train train.toml --psf DATA/mwdn-camera/psf_320.png --bin 5 --photos DATA/photos/test --device cpu --out",
    "reconstruct": "reconstruct DATA/diffusercam/diffuser_images --psf DATA/diffusercam/psf_recovered_270x480.npy "
    "--bin 2 --upside-down --bgr --background 0 --method wiener --format npy --resume --device cpu --out",
    "simulate": "simulate DATA/photos/test --psf DATA/mwdn-camera/psf_320.png --bin 2 --count 60 --out",
    "import": "import diffusercam DATA/diffusercam --out",
    "benchmark": "benchmark benchmark.toml --no-lpips --device cpu --out",
}


def start(command: str, data: Path, folder: Path, out: str) -> subprocess.Popen:
    words = [word.replace("DATA", str(data)) for word in command.split()]
    out += "/pairs.h5" if words[0] in ("simulate", "import") else ""
    line = [sys.executable, "-m", "mwdn", *words, out]
    return subprocess.Popen(line, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> None:
    _, err = process.communicate(timeout=600)
    assert process.returncode == 0, err


def assert_whole(out: Path) -> None:
    """Each visible file can be read to its end; a log may end in the middle of its last line."""
    for path in [path for path in out.rglob("*") if path.is_file() and not path.name.startswith(".")]:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".safetensors":
            load_file(path)
        elif path.suffix == ".png":
            read_frame(path)
        elif path.suffix == ".npy":
            np.load(path)
        elif path.suffix == ".h5":
            with h5py.File(path) as file:
                assert all(item[:].size for item in file.values() if isinstance(item, h5py.Dataset))


def assert_equal(one: Path, other: Path) -> None:
    """The same files; the same pictures, pairs and weights."""
    names = [{str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()} for out in (one, other)]
    assert {name for name in names[0] ^ names[1] if not name.endswith(".lock")} == set()
    for name in names[0] & names[1]:
        if name.endswith(".npy"):
            assert np.array_equal(np.load(one / name), np.load(other / name)), name
        elif name.endswith(".safetensors"):
            assert same(one / name, other / name), name
        elif name.endswith(".h5"):
            with h5py.File(one / name) as first, h5py.File(other / name) as second:
                assert first.keys() == second.keys()
                assert all(np.array_equal(first[key][:], second[key][:]) for key in first), name


@pytest.mark.parametrize("name", COMMANDS)
def test_nothing_is_lost(name: str, data: Path, tmp_path: Path) -> None:
    for file, text in (("train.toml", TRAINING), ("benchmark.toml", BENCHMARK)):
        (tmp_path / file).write_text(text.replace("DATA", str(data)))
    before = time.monotonic()
    (tmp_path / "others").mkdir()
    for photograph in sorted((data / "photos" / "train").iterdir())[:3]:
        shutil.copy(photograph, tmp_path / "others")
    finish(start(COMMANDS[name], data, tmp_path, "whole"))
    duration, generator = time.monotonic() - before, random.Random(29)
    kills = runs = 0
    while kills < KILLS:
        process, out = start(COMMANDS[name], data, tmp_path, f"run-{runs}"), tmp_path / f"run-{runs}"
        try:
            process.wait(generator.uniform(0.2, 1.1) * duration)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            kills += 1
            assert_whole(out)
            continue
        finish(process)
        assert_equal(tmp_path / "whole", out)
        runs += 1
    finish(start(COMMANDS[name], data, tmp_path, f"run-{runs}"))
    assert_equal(tmp_path / "whole", tmp_path / f"run-{runs}")
    print(f"{name}: {kills} kills, {runs + 1} runs ended as an unbroken one")
