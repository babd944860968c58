"""The house rules that a machine can check: who may import whom, what an import costs, what is documented."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
PACKAGE = SOURCE / "mwdn"
MODULES = sorted(PACKAGE.rglob("*.py"))

# From the ground up: a folder imports from itself and from the folders above it in this list, nothing else.
FLOORS = [
    "errors",
    "types",
    "version",
    "fourier",
    "runtime",
    "io",
    "optics",
    "calibration",
    "solvers",
    "data",
    "networks",
    "weights",
    "evaluation",
    "inference",
    "training",
    "export",
    "benchmark",
    "cli",
    "__main__",
    "",  # mwdn/__init__.py: the public names
]
FLOOR = {name: number for number, name in enumerate(FLOORS)}

NETWORKS_MAY_IMPORT = {"errors", "types", "fourier", "solvers", "networks"}
HEAVY = ["cv2", "h5py", "starlette", "matplotlib", "tifffile", "cyclopts", "skimage", "scipy"]


def dotted(path: Path) -> str:
    """``mwdn.networks.unet`` of a file, ``mwdn.networks`` of a folder's ``__init__.py``."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


KNOWN = {dotted(path) for path in MODULES}


def imports(path: Path) -> list[tuple[int, str]]:
    """Line and full name of each import, also of those inside functions."""
    found = []
    folder = dotted(path).split(".") if path.name == "__init__.py" else dotted(path).split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join([*folder[: len(folder) - node.level + 1], *([base] if base else [])])
            for alias in node.names:
                # `from mwdn import fourier` is a module, `from mwdn.fourier.convolution import wiener` a name of one.
                full = f"{base}.{alias.name}"
                if full == "mwdn.__version__":  # a string, not a module
                    continue
                found.append((node.lineno, full if full in KNOWN else base))
    return found


def folder(module: str) -> str:
    """Name in `FLOORS` that a module of mwdn belongs to."""
    return module.removeprefix("mwdn").removeprefix(".").split(".")[0]


def each(paths):
    return pytest.mark.parametrize("path", paths, ids=[dotted(path) for path in paths])


@each(MODULES)
def test_imports_point_down(path):
    own = folder(dotted(path))
    assert own in FLOOR, f"{path} is on no floor: give its folder a place in FLOORS"
    for line, name in imports(path):
        if name.split(".")[0] != "mwdn":
            continue
        other = folder(name)
        assert other in FLOOR, f"{path}:{line} imports {name}, which is on no floor"
        assert FLOOR[other] <= FLOOR[own], f"{path}:{line}: {own} must not import {name}, which is above it"


@each([path for path in MODULES if dotted(path).startswith("mwdn.networks")])
def test_networks_can_be_read_beside_the_paper(path):
    for line, name in imports(path):
        top = name.split(".")[0]
        if top == "mwdn":
            assert folder(name) in NETWORKS_MAY_IMPORT, f"{path}:{line} imports {name}"
        else:
            assert top in {"torch", "numpy"} | sys.stdlib_module_names, f"{path}:{line} imports {name}"


def test_nothing_is_imported_from_the_tests_or_relatively_beyond_the_package():
    for path in MODULES:
        for line, name in imports(path):
            assert name.split(".")[0] not in {"tests", "oracles", "conftest", ""}, f"{path}:{line}"


def test_only_fourier_mentions_torch_fft():
    """Elsewhere nobody would think of float32 and of where a PSF's centre is."""
    pattern = re.compile(r"torch\.fft|from\s+torch\s+import\s[^\n]*\bfft\b|\bfft\.i?r?fftn?2?\(")
    found = [dotted(path) for path in MODULES if pattern.search(path.read_text(encoding="utf-8"))]
    assert found == ["mwdn.fourier.transforms"]


def test_import_is_light():
    """In a fresh process, so that no other test has imported anything before."""
    code = f"import sys, mwdn; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def public(tree: ast.Module | ast.ClassDef, prefix: str = ""):
    """Public functions and classes, and the methods of the latter."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node.name[0] != "_":
            yield f"{prefix}{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{prefix}{node.name}.")


@each(MODULES)
def test_public_names_are_documented(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    missing = [f"{path}:{node.lineno} {name}" for name, node in public(tree) if not ast.get_docstring(node)]
    assert not missing
    assert ast.get_docstring(tree) or not tree.body, f"{path} does not say what it is for"


@each([path for path in MODULES if path.name == "__init__.py"])
def test_all_names_what_is_there(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = [
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__"
    ]
    if not names:
        assert not any(name.startswith("mwdn") for _, name in imports(path)), f"{path} needs an `__all__`"
        return
    assert len(set(names[0])) == len(names[0])
    bound = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    bound |= {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        bound |= {target.id for target in targets if isinstance(target, ast.Name)}
    if "__getattr__" not in bound:
        assert set(names[0]) <= bound
