"""The scripts of the gallery run, at a small size; what the site makes of them."""

import ast
import importlib.util
import json
import re
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted(path for path in (ROOT / "examples" / "gallery").glob("*.py") if path.stem != "__main__")
LIKELY = {  # what each prints, with its numbers left out
    "forward_model": r"a point gives the PSF.*two points give the sum.*<A x, y>",
    "wiener_or_admm": r"Wiener, 15,000 electrons: [\d.]+ dB.*ADMM, 500 electrons: [\d.]+ dB",
    "cropping": r"light on the small sensor: \d\d%.*cropped: .* dB in the middle.*whole: ",
    "mask": r"one pinhole, same time.*of the aperture's light.*diffuser, own time",
    "poor_light": r"wiener: [\d.]+ dB.*admm: .*universal-small: ",
    "ambient_light": r"of the light is the room's.*estimated from the capture: .*room's frame subtracted: .* dB",
    "features": r"learned numbers.*mean squared error.*scale 1: lambda.*scale 1/8: lambda",
    "live_stream": r"stream: 10.*100, each by itself.*\d frames shown, the last one among them: True",
    "wrong_psf": r"right: .*psf, good.*mirrored: .*another camera: ",
    "zero_shot": r"admm: [\d.]+ dB.*universal: [\d.]+ dB",
}
SLOW = ("ambient_light", "wrong_psf")
"""They search for the room's light or align several PSFs."""


@pytest.fixture(autouse=True)
def _no_window():
    matplotlib.use("agg")
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


def run_small(path, size):
    """Names of a script that was run with another SIZE, and few STEPS and FRAMES."""
    source, count = re.subn(r"^SIZE = \d+", f"SIZE = {size}", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert count == 1
    source = re.sub(r"^STEPS = \d+", "STEPS = 1", source, flags=re.MULTILINE)
    source = re.sub(r"^FRAMES = \d+", "FRAMES = 3", source, flags=re.MULTILINE)
    names = {"__name__": "gallery"}
    exec(compile(source, str(path), "exec"), names)
    return names


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.acceptance] * (path.stem in SLOW), id=path.stem)
        for path in SCRIPTS
        if path.stem != "zero_shot"
    ],
)
def test_a_script_runs_and_draws(path, capsys):
    figure = run_small(path, 48)["figure"]
    assert re.search(LIKELY[path.stem], capsys.readouterr().out, re.DOTALL)
    pictures = [image.get_array() for axis in figure.axes for image in axis.get_images()]
    assert len(pictures) >= 3
    assert all(np.isfinite(picture).all() and picture.max() > picture.min() for picture in pictures)


@pytest.mark.acceptance
def test_the_network_of_the_gallery_is_better_than_admm(capsys):
    path = ROOT / "examples" / "gallery" / "zero_shot.py"
    run_small(path, 96)
    printed = capsys.readouterr().out
    assert re.search(LIKELY["zero_shot"], printed, re.DOTALL)
    numbers = np.array([float(number) for number in re.findall(r": ([\d.]+) dB", printed)]).reshape(-1, 2)
    assert (numbers[:, 1] > numbers[:, 0]).all()


def test_every_script_has_its_picture_its_text_and_its_page():
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    spec = importlib.util.spec_from_file_location("site_gallery", ROOT / "docs" / "site" / "gallery.py")
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    assert set(hook.ORDER) == {path.stem for path in SCRIPTS} == set(LIKELY)
    index = (ROOT / "docs" / hook.INDEX).read_text(encoding="utf-8")
    for path in SCRIPTS:
        kept = ROOT / "docs" / "gallery" / path.stem
        printed = kept.with_suffix(".txt").read_text(encoding="utf-8")
        assert kept.with_suffix(".webp").stat().st_size < 100_000
        assert re.search(LIKELY[path.stem], printed, re.DOTALL)
        title, cells = hook.read_cells(path.read_text(encoding="utf-8"))
        assert f"[{title}](../../examples/gallery/{path.name})" in index
        script = ast.parse(path.read_text(encoding="utf-8"))
        listed = json.loads(hook.notebook(title, cells))["cells"]
        code = "\n".join(cell["source"] for cell in listed if cell["cell_type"] == "code")
        assert ast.dump(ast.parse(code)) == ast.dump(ast.Module(script.body[1:], []))
