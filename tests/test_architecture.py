"""The house rules that a machine can check. Each test lists all offenders as ``file:line``."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import reduce
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "mwdn"

FLOORS = [
    "errors",
    "arguments",
    "first_use",
    "types",
    "version",
    "fourier",
    "runtime",
    "io",
    "optics",
    "calibration",
    "solvers",
    "data",
    "capture",
    "networks",
    "weights",
    "evaluation",
    "diagnosis",
    "inference",
    "registration",
    "preview",
    "training",
    "export",
    "bridges",
    "benchmark",
    "cli",
    "__main__",
    "",  # mwdn/__init__.py: the public names
]
"""From the ground up: a folder imports from itself and from those before it in this list, nothing else."""

NETWORKS_MAY_IMPORT = {"errors", "arguments", "types", "fourier", "runtime", "optics", "solvers", "networks"}
HEAVY = {"cv2", "h5py", "starlette", "uvicorn", "matplotlib", "tifffile", "rawpy", "skimage", "scipy"}

LONGEST = 300
"""Lines of a file."""


def dotted(path: Path) -> str:
    """``mwdn.networks.unet`` of a file, ``mwdn.networks`` of a folder's ``__init__.py``."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {path: ast.parse(text) for path, text in FILES.items()}
MODULES = {dotted(path) for path in FILES}


def place(path: Path, line: int = 1) -> str:
    return f"{path.relative_to(ROOT)}:{line}"


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and full name of each imported module, inside functions too."""
    package = dotted(path).split(".")[: None if path.name == "__init__.py" else -1]
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                # `from mwdn import fourier` names a module, `from mwdn.fourier import wiener` a function of one.
                full = f"{source}.{alias.name}"
                yield node.lineno, full if full in MODULES else source


def floor(module: str) -> str:
    """Name in `FLOORS` of a module of mwdn."""
    return module.removeprefix("mwdn").removeprefix(".").split(".")[0]


def test_imports_point_down():
    unknown = [place(path) for path in FILES if floor(dotted(path)) not in FLOORS]
    assert not unknown, "their folder needs a place in FLOORS"
    upwards = [
        f"{place(path, line)} imports {name}"
        for path in FILES
        for line, name in imports(path)
        if name.split(".")[0] == "mwdn" and FLOORS.index(floor(name)) > FLOORS.index(floor(dotted(path)))
    ]
    assert not upwards


def test_networks_can_be_read_beside_the_paper():
    """They import torch, numpy and the lower folders only."""
    others = {"torch", "numpy"} | sys.stdlib_module_names
    beyond = [
        f"{place(path, line)} imports {name}"
        for path in FILES
        if floor(dotted(path)) == "networks"
        for line, name in imports(path)
        if (floor(name) not in NETWORKS_MAY_IMPORT if name.startswith("mwdn") else name.split(".")[0] not in others)
    ]
    assert not beyond


def test_nothing_is_imported_from_the_tests_or_relatively_beyond_the_package():
    tests = {"", "tests", *(path.stem for path in (ROOT / "tests").glob("*.py"))}
    assert not [place(path, line) for path in FILES for line, name in imports(path) if name.split(".")[0] in tests]


def test_only_fourier_mentions_torch_fft():
    """There alone: float32, and where the centre of a PSF is."""
    pattern = re.compile(r"torch\.fft|from\s+torch\s+import\s[^\n]*\bfft\b|\bfft\.i?r?fftn?2?\(")
    assert [dotted(path) for path, text in FILES.items() if pattern.search(text)] == ["mwdn.fourier.transforms"]


SCRIPTS = [path for folder in ("benchmarks", "docs", "examples") for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_scripts_name_what_the_package_has(path):
    """No other test runs most of them: `benchmarks/engine.py` patched a function that had moved."""
    tree, found = ast.parse(path.read_text(encoding="utf-8")), {}
    lost = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mwdn":
            if node.module == "mwdn.bridges":  # of libraries that need not be installed
                continue
            module = import_module(node.module)
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                value = import_module(full) if full in MODULES else getattr(module, alias.name, None)
                lost += [full] if value is None else []
                found[alias.asname or alias.name] = value
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("patch.object"):
            owner, name = node.args[0], node.args[1]
            parts = ast.unparse(owner).split(".")
            value = reduce(lambda value, part: getattr(value, part, None), parts[1:], found.get(parts[0]))
            named = name.value if isinstance(name, ast.Constant) else ""
            lost += [f"{ast.unparse(owner)}.{named}"] if value is None or not hasattr(value, named) else []
    assert not lost


HELP = "from mwdn.cli import main\nwith suppress(SystemExit): main({})"


@pytest.mark.parametrize(
    ("code", "missing"),
    [
        ("", HEAVY | {"torch", "numpy", "cyclopts"}),
        *((HELP.format(arguments), HEAVY | {"torch", "numpy"}) for arguments in ([], ["--help"], ["--version"])),
        (HELP.format(["doctor", "--help"]), HEAVY | {"torch", "numpy"}),
        (HELP.format(["recipes"]), {"torch"}),
        ("import mwdn.data\nfor name in mwdn.__all__: getattr(mwdn, name)", HEAVY | {"cyclopts"}),
    ],
)
def test_import_is_light(code, missing):
    """In a fresh process, where no other test has imported anything."""
    code = f"import sys, mwdn\nfrom contextlib import suppress\n{code}\nprint(*sys.modules, file=sys.stderr)"
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True, timeout=600
    )
    assert not missing & set(process.stderr.split())


def public(tree: ast.Module | ast.ClassDef, prefix: str = ""):
    """Public functions and classes, and the methods of the latter."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node.name[0] != "_":
            if "overload" in map(ast.unparse, node.decorator_list):
                continue  # the implementation has the docstring
            yield f"{prefix}{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{prefix}{node.name}.")


def test_public_names_are_documented():
    modules = [place(path) for path, tree in TREES.items() if tree.body and not ast.get_docstring(tree)]
    names = [
        f"{place(path, node.lineno)} {name}"
        for path, tree in TREES.items()
        for name, node in public(tree)
        if not ast.get_docstring(node)
    ]
    assert not modules + names


def test_files_are_short():
    lengths = {path: len(text.splitlines()) for path, text in FILES.items()}
    long = [place(path, length) for path, length in lengths.items() if length > LONGEST]
    assert not long, f"they end at these lines; the most is {LONGEST}"


def bound(tree: ast.Module) -> set[str]:
    """Names that a module's imports, functions, classes and assignments make."""
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            stored = (each for each in ast.walk(node) if isinstance(getattr(each, "ctx", None), ast.Store))
            names |= {each.id for each in stored if isinstance(each, ast.Name)}
    return names


def listed(tree: ast.Module) -> list[str] | None:
    """What `__all__` holds."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return ast.literal_eval(node.value)
    return None


def test_a_folder_lists_its_names_once_and_has_them():
    wrong = []
    for path, tree in TREES.items():
        if path.name != "__init__.py":
            continue
        names, known = listed(tree), bound(tree)
        if names is None and any(name.startswith("mwdn") for _, name in imports(path)):
            wrong.append(f"{place(path)} needs an `__all__`")
        elif names and len(set(names)) < len(names):
            wrong.append(f"{place(path)} lists a name twice")
        elif names and "__getattr__" not in known and not set(names) <= known:
            wrong.append(f"{place(path)} lists {set(names) - known}, which it does not have")
    assert not wrong


def test_scripts_import_names_that_exist():
    """Those of benchmarks, documents and examples, most of which no test runs."""
    known = {dotted(path): bound(tree) | set(listed(tree) or ()) for path, tree in TREES.items()}
    missing = [
        f"{place(path, node.lineno)} imports {alias.name} from {node.module}"
        for folder in ("benchmarks", "docs", "examples")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mwdn"
        for alias in node.names
        if alias.name not in known.get(node.module, ()) and f"{node.module}.{alias.name}" not in MODULES
    ]
    assert not missing


def test_no_message_names_a_page_that_a_wheel_lacks():
    """Messages name `mwdn explain TOPIC` instead."""
    docstrings = {id(node.value) for tree in TREES.values() for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    named = [
        place(path, node.lineno)
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings
        if re.search(r"docs/[\w-]+\.md", node.value)
    ]
    assert not named
