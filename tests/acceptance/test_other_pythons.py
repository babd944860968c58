"""Later Pythons, as far as they go without torch: CPU builds of it are not to be had for them everywhere.

Every file compiles without a warning, every dependency but torch is there with the version of constraints.txt, every
module that does not need torch is imported, and the commands that start without torch run.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PYENV = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"

IMPORTS = """
import importlib, pkgutil, warnings
import mwdn
warnings.simplefilter("error")
found = missing = 0
for module in pkgutil.walk_packages(mwdn.__path__, "mwdn."):
    try:
        importlib.import_module(module.name)
        found += 1
    except ModuleNotFoundError as error:
        assert error.name.split(".")[0] in ("torch", "safetensors"), (module.name, error)
        missing += 1
print(found, missing)
"""

pytestmark = pytest.mark.acceptance


@pytest.fixture(params=["3.12", "3.13"])
def python(request):
    """An interpreter of this version, on the path or from pyenv."""
    places = [f"python{request.param}", *sorted(map(str, PYENV.glob(f"{request.param}.*/bin/python")))]
    for place in places:
        try:
            asked = subprocess.run(
                [place, "-c", "import sys; print(sys.version)"], capture_output=True, text=True, check=False
            )
        except OSError:
            continue
        if asked.stdout.startswith(request.param):
            return place
    pytest.skip(f"No Python {request.param} on this computer")


def run(*line, **options):
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=900, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_compiles_without_a_warning(python, tmp_path):
    here = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path), "PYTHONDONTWRITEBYTECODE": ""}
    folders = [str(ROOT / name) for name in ("src", "tests", "benchmarks", "examples")]
    run(python, "-W", "error", "-m", "compileall", "-q", "-f", *folders, env=here)


def test_what_starts_without_torch(python, tmp_path):
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    run(*build, cwd=ROOT, env=environment)
    run(python, "-m", "venv", str(tmp_path / "venv"))
    inside = str(tmp_path / "venv" / "bin" / "python")
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [pin for pin in pins if pin.partition("==")[0] in DEPENDENCIES]
    assert len(pins) == len(DEPENDENCIES)
    (wheel,) = tmp_path.glob("*.whl")
    pip = (inside, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary", ":all:")
    run(*pip, *pins)
    run(*pip, "--no-deps", str(wheel))
    clean = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    mwdn = (inside, "-W", "error", "-m", "mwdn")
    assert run(*mwdn, "--version", cwd=tmp_path, env=clean).strip()
    assert "quick-cpu" in run(*mwdn, "recipes", cwd=tmp_path, env=clean)
    assert "What to do" in run(*mwdn, "explain", "gamma", cwd=tmp_path, env=clean)
    found, missing = map(int, run(inside, "-c", IMPORTS, cwd=tmp_path, env=clean).split())
    print(f"{found} modules without torch, {missing} need it")
    assert found > 30


DEPENDENCIES = (
    *("numpy", "jaxtyping", "wadler_lindig", "opencv-python-headless", "tifffile", "h5py", "safetensors"),
    *("cyclopts", "docstring_parser", "rich-rst", "attrs", "rich", "markdown-it-py", "mdurl", "Pygments"),
    *("matplotlib", "contourpy", "cycler", "fonttools", "kiwisolver", "packaging", "pillow", "pyparsing"),
    *("python-dateutil", "filelock"),
)
"""The dependencies of pyproject.toml but torch, with theirs."""
