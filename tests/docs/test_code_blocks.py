"""The Python code of README and docs runs, page by page, in a folder with a PSF, a capture and photographs.

A block below `<!-- not run: REASON -->` is not run; one below `<!-- needs: LIBRARY -->` only where that is installed.
Names that a page assumes: `camera`, an iterable of raw frames, and `show`.
"""

import re
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

import mwdn
from mwdn.io.images import write_frame
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"(?:<!-- (not run|needs): ([^\n]+) -->\n)?```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = {
    path.relative_to(ROOT).as_posix(): blocks
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if (blocks := BLOCK.findall(path.read_text(encoding="utf-8")))
}
SLOW = {"docs/capture.md", "docs/optics.md"}
"""A hundred frames of the rig; diffraction at full size."""


def test_blocks_are_found_and_few_are_left_out():
    marks = [mark for blocks in PAGES.values() for mark, *_ in blocks]
    assert len(marks) > 6
    assert marks.count("not run") <= 2


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder of a reader."""
    psf = sample_camera(11, (64, 64))
    light = mwdn.convolve(dark_scene("cat", (64, 64), 40), psf)
    for name, image in (("psf", psf), ("capture", light)):
        frame = (image / image.max() * 60000)[0].movedim(0, -1).numpy().astype(np.uint16)
        write_frame(tmp_path / f"{name}.png", np.ascontiguousarray(frame))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mwdn, "keep_memory", lambda: None)  # would change this process for good
    return tmp_path


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.acceptance] if page in SLOW else []) for page in PAGES]
)
def test_python_code_runs(page, folder):
    shown = []
    names = {"__name__": "page", "camera": 2 * [mwdn.read_frame("capture.png")], "show": shown.append}
    for mark, what, code in PAGES[page]:
        if not mark or (mark == "needs" and find_spec(what)):
            exec(compile(code.replace('"universal"', '"universal-small"'), page, "exec"), names)  # a tenth of its time
    if page == "README.md":
        assert mwdn.read_picture("scene.png").shape == (1, 3, 64, 64)
        assert torch.isfinite(names["loss"])
    if page == "docs/reconstruct.md":
        assert len(shown) >= 1
