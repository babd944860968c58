"""Every file of the repository that is no text has its origin and licence in docs/releasing.md."""

import re
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ASSETS = {".jpg", ".png", ".webp", ".safetensors", ".npy", ".npz", ".h5", ".onnx", ".tif", ".tiff", ".ttf", ".woff2"}


def test_every_asset_has_its_origin_and_licence():
    section = (ROOT / "docs" / "releasing.md").read_text(encoding="utf-8").partition("## Where each asset")[2]
    rows = [row.split(" | ") for row in section.splitlines() if row.startswith("| `")]
    patterns = {name: row for row in rows for name in re.findall(r"`([^`]+)`", row[0])}
    assert all(len(row) == 3 and row[1].strip() and row[2].strip(" |") for row in patterns.values())
    files = [path for folder in ("src", "docs", "benchmarks", "examples") for path in (ROOT / folder).rglob("*")]
    names = [path.relative_to(ROOT).as_posix() for path in files if path.suffix in ASSETS]
    assert [name for name in names if not any(fnmatch(name, pattern) for pattern in patterns)] == []
    assert [pattern for pattern in patterns if not any(fnmatch(name, pattern) for name in names)] == []
