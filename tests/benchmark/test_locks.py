"""Several processes at one benchmark."""

import signal
import subprocess
import sys
import time

import pytest

from mwdn.benchmark.locks import claim_parts, lock
from mwdn.errors import ParameterError

AT_WORK = """
import sys, time
from pathlib import Path
from mwdn.benchmark.locks import claim_parts

folder = Path(sys.argv[1])
for part in claim_parts(folder, ["a", "b", "c", "d"]):
    done = folder / part
    if not done.exists():
        with done.open("x") as file:  # fails if another is at it
            time.sleep(float(sys.argv[2]))
    print(part, flush=True)
"""


def at_work(folder, seconds):
    call = [sys.executable, "-c", AT_WORK, str(folder), str(seconds)]
    return subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_each_part_is_done_once_and_all_wait_for_the_last(tmp_path):
    workers = [at_work(tmp_path, 0.2) for _ in range(2)]
    said = [worker.communicate(timeout=600) for worker in workers]
    assert [error for _, error in said] == ["", ""]
    assert all(sorted(out.split()) == ["a", "b", "c", "d"] for out, _ in said)


def test_a_part_of_a_killed_process_is_another_ones(tmp_path):
    worker = at_work(tmp_path, 600)
    while not (tmp_path / "a").exists():
        time.sleep(0.05)
    parts = claim_parts(tmp_path, ["a", "b"])
    assert next(parts) == "b"
    worker.send_signal(signal.SIGKILL)
    worker.communicate()
    assert next(parts) == "a"
    assert list(parts) == []


def test_a_folder_that_cannot_be_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(ParameterError, match="must be a folder"):
        lock(tmp_path / "out", "data")
