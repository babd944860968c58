"""The wheel and the sdist: built twice, installed into a clean environment, and used from outside the repository."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUILD_S, INSTALL_S, RUN_S = 120, 900, 600

pytestmark = pytest.mark.acceptance


def build(folder, *, of=ROOT, target=None):
    """The files that hatchling builds, at the time of the commit as `make package` does."""
    words = [sys.executable, "-m", "hatchling", "build", "-d", folder, *(["-t", target] if target else [])]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}
    subprocess.run(words, check=True, timeout=BUILD_S, cwd=of, env=environment, capture_output=True)
    return {path.name.partition("-py3")[0]: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    build(folder)
    return folder


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """``installed("mwdn", "--version")`` runs a program of a clean environment, outside the repository."""
    place = tmp_path_factory.mktemp("clean")
    subprocess.run([sys.executable, "-m", "venv", place / "venv"], check=True, timeout=INSTALL_S)
    clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    (wheel,) = built.glob("*.whl")

    def run(program, *words, timeout=RUN_S):
        line = [place / "venv" / "bin" / program, *words]
        return subprocess.run(line, check=True, timeout=timeout, cwd=place, env=clean, capture_output=True, text=True)

    run("pip", "install", "--quiet", "-c", ROOT / "constraints.txt", wheel, timeout=INSTALL_S)
    run.place = place
    return run


def test_two_builds_are_equal_and_a_wheel_of_the_sdist_is_the_wheel(built, tmp_path):
    first = {path.name.partition("-py3")[0]: path.read_bytes() for path in built.iterdir()}
    assert build(tmp_path / "again") == first
    (sdist,) = built.glob("*.tar.gz")
    subprocess.run(["tar", "xzf", sdist, "-C", tmp_path], check=True, timeout=60)
    (unpacked,) = tmp_path.glob("mwdn-*")
    (wheel,) = built.glob("*.whl")
    assert list(build(tmp_path / "of-sdist", of=unpacked, target="wheel").values()) == [wheel.read_bytes()]


def test_the_wheel_has_every_file_of_the_package(built):
    (wheel,) = built.glob("*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("mwdn/")}
    tracked = subprocess.run(["git", "ls-files", "src/mwdn"], check=True, capture_output=True, text=True, cwd=ROOT)
    assert names == {name.removeprefix("src/") for name in tracked.stdout.split()}


def test_commands_work_without_the_repository(installed):
    where = installed("python", "-c", "import mwdn; print(mwdn.__file__)").stdout
    assert str(installed.place) in where
    from mwdn.io.toml import packaged_recipes
    from mwdn.version import __version__

    assert installed("mwdn", "--version").stdout.strip() == __version__
    assert all(name in installed("mwdn", "recipes").stdout for name in packaged_recipes())
    assert "What to do" in installed("mwdn", "explain", "gamma").stdout
    assert "universal" in installed("mwdn", "methods").stdout


def test_a_plugin_is_installed_beside_it(installed):
    installed("pip", "install", "--quiet", "--no-deps", ROOT / "examples" / "plugin", timeout=INSTALL_S)
    listed = installed("mwdn", "methods").stdout
    assert "richardson-lucy" in listed
    assert "residual" in listed
    installed("pip", "uninstall", "--quiet", "--yes", "mwdn-example")
    assert "richardson-lucy" not in installed("mwdn", "methods").stdout


def test_demo_and_a_reconstruction_work_without_the_repository(installed):
    place = installed.place
    assert "PSNR in dB" in installed("mwdn", "demo", "--pictures", "cat", "--out", "demo").stdout
    assert (place / "demo" / "comparison.png").stat().st_size > 100_000
    code = (
        "import mwdn, numpy as np; from mwdn.optics import sample_camera; from mwdn.io.pictures import dark_scene\n"
        "psf = sample_camera(0, (128, 128)); light = mwdn.convolve(dark_scene('cat', (128, 128), 80), psf)\n"
        "for name, x in (('psf', psf), ('capture', light)): np.save(name, (x / x.max())[0].movedim(0, -1).numpy())\n"
    )
    installed("python", "-c", code)
    result = installed("mwdn", "reconstruct", "capture.npy", "--psf", "psf.npy", "--background", "0", "--out", "out")
    assert "the picture reproduces" in result.stdout
    assert {path.name for path in (place / "out").iterdir()} == {"capture.png", "capture.json", "summary.png"}
