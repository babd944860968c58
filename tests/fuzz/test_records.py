"""Damaged files of a benchmark's and a training's folder: 203 of 320 ended in tracebacks that named no file."""

import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driver import damaged, failures, sweep

from image_files import npy
from mwdn.benchmark import scoring, training
from mwdn.training.run_folder import RunFolder

SCORES = {
    "values": {"psnr": [20.5, None], "ssim": [0.5, 0.25]},
    "seconds": [0.1, 0.2],
    "peak_bytes": 1000,
    "device": "cpu",
    "learnable": 0,
}
RECORD = {"identity": {"method": ["admm", {}]}, "scores": SCORES, "cpu": None, "missing": {"lpips": "not asked for"}}
LOG = b'{"step": 0, "loss": 0.5, "psnr": null}\n{"step": 1, "loss": 0.5, "psnr": 20.5}\n' * 2
PICTURES = npy(np.zeros((2, 3, 4, 5), np.float32))


def read(path: Path) -> Any:
    """As the benchmark reads its files."""
    match path.name:
        case "clock.json":
            return training.seconds(path.parent)
        case "log.jsonl":
            return training.curve(path.parent)
        case _:
            path = path.parent / "admm.json"
            record = scoring.read_record(path, RECORD["identity"])
            return record and scoring.saved_result(path, record)


FILES = {
    "admm.json": json.dumps(RECORD, indent=1).encode(),
    "admm-pictures.npy": PICTURES,
    training.CLOCK: b'{"step": 4, "seconds": 12.5}',
    "log.jsonl": LOG,
}


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file_is_named(tmp_path: Path, name: str) -> None:
    for other, content in FILES.items() | {("admm-captures.npy", PICTURES)}:
        (tmp_path / other).write_bytes(content)
    random = np.random.default_rng([29, *name.encode()])
    contents = (damaged(FILES[name], random) for _ in iter(int, 1))
    assert failures(sweep(islice(contents, 80), read, tmp_path / name)) == []


def test_a_byte_of_the_log_that_is_not_utf8_does_not_end_a_training(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path, {"recipe": {}, "psf_hash": ""})
    folder.claim(0)
    (tmp_path / "log.jsonl").write_bytes(LOG.replace(b"0.5", b"\xff.5", 1))
    folder.claim(2)
    assert (tmp_path / "log.jsonl").read_bytes().splitlines()[1:] == LOG.splitlines()[1:2]
