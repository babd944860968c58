"""Hook of the site: one page for each public subpackage, from its docstrings."""

import ast
from collections.abc import Iterable
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "mwdn"
COMMANDS_ONLY = {"cli", "preview"}

TOP = """# mwdn

What `import mwdn` offers. Each name is imported at its first use, so `import mwdn` does not wait for torch.

| name | in |
| --- | --- |
{names}

All subpackages: {packages}. Every error that this package raises on purpose is an
[`MwdnError`](mwdn.errors.md).
[Plugins](../plugins.md) add networks, solvers, masks and cameras.
"""


def _assigned(path: Path, name: str) -> list[str] | dict[str, str]:
    """Literal that a module assigns to a name, read without importing it."""
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and getattr(statement.targets[0], "id", "") == name:
            value: list[str] | dict[str, str] = ast.literal_eval(statement.value)
            return value
    raise ValueError(f"{path} assigns nothing to {name}")


PAGES = {
    f"mwdn.{path.parent.name}": _assigned(path, "__all__")
    for path in sorted(PACKAGE.glob("*/__init__.py"))
    if path.parent.name not in COMMANDS_ONLY
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the pages to the navigation."""
    pages = [{name: f"api/{name}.md"} for name in ("mwdn", *PAGES, "mwdn.errors")]
    config.nav = [*(config.nav or []), {"Python": pages}]
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Write the pages."""
    pages = {package: _page(package, names) for package, names in PAGES.items()}
    pages |= {"mwdn": _top(), "mwdn.errors": "# mwdn.errors\n\n::: mwdn.errors\n"}
    for name, text in pages.items():
        files.append(File.generated(config, f"api/{name}.md", content=text))
    return files


def _page(package: str, names: Iterable[str]) -> str:
    """The docstring of the package, then each public name under a heading of its own."""
    blocks = [f"# {package}", f"::: {package}\n    options:\n      members: []\n      show_root_toc_entry: false"]
    for name in names:
        blocks.append(f"::: {_place(package, name)}\n    options:\n      show_root_heading: true")
    return "\n\n".join(blocks)


def _place(package: str, name: str) -> str:
    """Dotted name of a public name. A module of the same name, such as `fourier/wiener.py`, would hide a function."""
    hidden = (PACKAGE / package.partition(".")[2] / f"{name}.py").exists()
    return f"{package}.{name}.{name}" if hidden else f"{package}.{name}"


def _top() -> str:
    places = _assigned(PACKAGE / "__init__.py", "_MODULES")
    assert isinstance(places, dict)
    rows = []
    for name, module in places.items():
        package = f"mwdn.{module.partition('.')[0]}"
        anchor = f"#{_place(package, name)}" if name in PAGES.get(package, ()) else ""
        rows.append(f"| [`mwdn.{name}`]({package}.md{anchor}) | `mwdn.{module}` |")
    packages = ", ".join(f"[`{name}`]({name}.md)" for name in PAGES)
    return TOP.format(names="\n".join(rows), packages=packages)
