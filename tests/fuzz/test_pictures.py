"""Damaged and made-up pictures, frames and texts: taken or refused on one line, within 1 GiB and a few seconds."""

from itertools import islice
from pathlib import Path

import pytest
from driver import DURATION_S, failures, outcome, sweep
from pictures import BOMBS, FILES, SLOW_TO_MAKE, cases, compare, differs, read, write_bomb


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file_is_taken_or_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str) -> None:
    assert failures(sweep(islice(cases(name), 20), read, tmp_path / name)) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.acceptance] * (name in SLOW_TO_MAKE)) for name in BOMBS]
)
def test_a_bomb_is_refused(tmp_path: Path, name: str) -> None:
    """A TIFF of 6.3 MB took 12.2 GB, a JPEG of 41 kB 87 s; sparse files were read before their header was judged."""
    write_bomb(tmp_path / name)
    assert outcome(lambda: read(tmp_path / name), tmp_path / name) == "refused"


def test_most_jpegs_that_look_different_are_refused(tmp_path: Path) -> None:
    """Before libjpeg's warnings counted, every second one read as good."""
    path, taken, content = tmp_path / "baseline.jpg", 0, []
    path.write_bytes(FILES[path.name])
    reference = read(path)
    for data in islice(cases(path.name), 100):
        path.write_bytes(data)
        if outcome(lambda: content.append(read(path)), path) == "taken":
            taken += compare(content.pop(), reference) == "different"
    visible = sum(differs(data, reference) for data in islice(cases(path.name), 100))
    assert visible > 80
    assert taken < visible / 4


@pytest.mark.acceptance
@pytest.mark.parametrize("name", FILES)
def test_many_damaged_files(tmp_path: Path, name: str) -> None:
    """A quarter of ``MWDN_FUZZ_SECONDS`` for all kinds together."""
    assert failures(sweep(cases(name, seed=1), read, tmp_path / name, duration_s=DURATION_S / len(FILES))) == []
