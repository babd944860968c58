"""Damaged cameras, masks, recordings, journals, states: taken or refused on one line, within the driver's limits."""

from pathlib import Path

import numpy as np
import pytest
from driver import damaged, failures, sweep
from other_files import NAMES, UNNAMED, Kind, kinds, written


@pytest.fixture(scope="module")
def every() -> dict[str, Kind]:
    every = kinds()
    assert set(every) == set(NAMES)
    return every


@pytest.fixture(autouse=True)
def _environment(monkeypatch: pytest.MonkeyPatch, unchecked: None) -> None:
    monkeypatch.setenv("MWDN_DATA", "/nowhere")


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_taken_or_refused(tmp_path: Path, name: str, every: dict[str, Kind]) -> None:
    files, file, read = every[name]
    read(written(tmp_path, files) / file)  # the whole one is taken
    random = np.random.default_rng([34, *name.encode()])
    for _ in range(10):
        outcomes = sweep(
            [damaged(files[file], random)], read, written(tmp_path, files) / file, named=name not in UNNAMED
        )
        assert failures(outcomes) == []
