"""The driver must see what it is for: a bomb, a loop, a foreign traceback, a long or many-lined message."""

from pathlib import Path

import driver
import numpy as np
import pytest
from driver import damaged, failures, outcome, sweep

from mwdn.errors import ParameterError


def loop():
    while True:
        pass


def refuse(text):
    raise ParameterError(f"`a.bin` {text}")


@pytest.mark.parametrize(
    ("read", "expected"),
    [
        (lambda: None, "taken"),
        (lambda: refuse("is short."), "refused"),
        (lambda: refuse("x" * 301), "refused"),  # every message ends at 300 characters
        (lambda: np.ones(2**31, np.uint8), "wrong: MemoryError"),
        (lambda: {}["a"], "wrong: KeyError"),
        (loop, "wrong: more than"),
    ],
)
def test_outcomes(read, expected, monkeypatch):
    monkeypatch.setattr(driver, "PROCESSOR_S", 0.2)
    assert outcome(read, Path("a.bin")).startswith(expected)


def test_damage_is_seeded_and_each_case_runs(tmp_path):
    data = bytes(range(256)) * 4
    first, again = ([damaged(data, np.random.default_rng(5)) for _ in range(3)] for _ in range(2))
    assert first == again
    assert all(content != data for content in first)
    outcomes = sweep([b"", b"a", b"b"], lambda path: path.read_bytes()[0], tmp_path / "a.bin")
    assert outcomes["taken"] == 2
    assert failures(outcomes) == ["wrong: IndexError: 'index out of range' (case 0)"]
