"""Every file of the repository that is no text, and every drawing, has its origin and licence in docs/releasing.md."""

import re
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("src", "docs", "benchmarks", "examples", "tests")
DRAWINGS = {".svg"}


def is_asset(path):
    """Whether a file is a drawing, or no text: text has no zero bytes and is UTF-8."""
    if not path.is_file() or "__pycache__" in path.parts:
        return False
    with path.open("rb") as file:
        start = file.read(4096)
    try:
        start[:4000].decode()
    except UnicodeDecodeError as error:
        return error.start < 3990  # the last character may be cut off
    return b"\0" in start or path.suffix in DRAWINGS


@pytest.mark.parametrize(
    ("name", "content", "asset"),
    [
        ("a.py", "é".encode() * 3000, False),
        ("b.py", b"a" + "é".encode() * 3000, False),
        ("a.jpg", b"\xff\xd8\xff", True),
        ("a.npy", b"\0abc", True),
        ("a.svg", b"<svg/>", True),
    ],
)
def test_what_an_asset_is(tmp_path, name, content, asset):
    (tmp_path / name).write_bytes(content)
    assert is_asset(tmp_path / name) == asset


def test_every_asset_has_its_origin_and_licence():
    section = (ROOT / "docs" / "releasing.md").read_text(encoding="utf-8").partition("## Where each asset")[2]
    rows = [row.split(" | ") for row in section.splitlines() if row.startswith("| `")]
    patterns = {name: row for row in rows for name in re.findall(r"`([^`]+)`", row[0])}
    assert all(len(row) == 3 and row[1].strip() and row[2].strip(" |") for row in patterns.values())
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    names = [path.relative_to(ROOT).as_posix() for path in files if is_asset(path)]
    assert [name for name in names if not any(fnmatch(name, pattern) for pattern in patterns)] == []
    assert [pattern for pattern in patterns if not any(fnmatch(name, pattern) for name in names)] == []
