"""Hook of the site: a page and a notebook for each script of examples/gallery.

A script is a docstring and cells, separated by `# %%`; a cell may begin with comments, which become text. Its picture
and what it printed are kept in docs/gallery by `python examples/gallery`.
"""

import ast
import json
import re
from pathlib import Path
from typing import NamedTuple

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "examples" / "gallery"
INDEX = "gallery/README.md"
ORDER = (
    *("forward_model", "wiener_or_admm", "cropping", "mask", "poor_light", "ambient_light", "wrong_psf", "zero_shot"),
    *("features", "live_stream"),
)


class Cell(NamedTuple):
    """Text, Markdown, and the code below it; either may be empty."""

    text: str
    code: str


def read_cells(source: str) -> tuple[str, list[Cell]]:
    """Title and cells of a script. The first cell has the rest of the docstring and the imports."""
    title, _, introduction = (ast.get_docstring(ast.parse(source)) or "").partition("\n")
    first, *others = source.split("\n# %%\n")
    cells = [Cell(introduction.strip(), first.split('"""', 2)[2].strip())]
    for cell in others:
        lines = cell.strip().splitlines()
        count = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
        text = " ".join(line.removeprefix("#").strip() for line in lines[:count])
        cells.append(Cell(text, "\n".join(lines[count:]).strip()))
    return title, cells


def describe(name: str, title: str, cells: list[Cell], printed: str) -> str:
    """The Markdown of a script."""
    parts = [f"# {title}"]
    for index, (text, code) in enumerate(cells):
        parts += [text, f"```python\n{code}\n```" if code else ""]
        if index == 0:
            parts.insert(2, f"![{title}]({name}.webp)")
    parts += ["It prints:", f"```text\n{printed.strip()}\n```"]
    parts.append(f"Download: [script]({name}.py), [notebook]({name}.ipynb).")
    return "\n\n".join(filter(None, parts)) + "\n"


def notebook(title: str, cells: list[Cell]) -> str:
    """The same as a Jupyter notebook (nbformat 4), not executed."""
    listed = []
    for index, (text, code) in enumerate(cells):
        text = f"# {title}\n\n{text}" if index == 0 else text
        if text:
            listed.append({"cell_type": "markdown", "id": f"text-{index}", "metadata": {}, "source": text})
        if code:
            entry = {"cell_type": "code", "id": f"code-{index}", "metadata": {}, "source": code}
            listed.append({**entry, "outputs": [], "execution_count": None})
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return json.dumps({"nbformat": 4, "nbformat_minor": 5, "metadata": kernel, "cells": listed}, indent=1)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the pages to the navigation, after those for the use of a camera."""
    pages = [{"All": INDEX}]
    pages += [{read_cells(_source(name))[0]: f"gallery/{name}.md"} for name in ORDER]
    config.nav = [*(config.nav or []), {"Gallery": pages}]
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Write the pages and the notebooks."""
    for name in ORDER:
        source = _source(name)
        title, cells = read_cells(source)
        printed = (ROOT / "docs" / "gallery" / f"{name}.txt").read_text(encoding="utf-8")
        contents = {"md": describe(name, title, cells, printed), "py": source, "ipynb": notebook(title, cells)}
        for suffix, content in contents.items():
            files.append(File.generated(config, f"gallery/{name}.{suffix}", content=content))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: object) -> str:
    """The list of scripts leads to their pages; on GitHub, to the scripts."""
    return (
        re.sub(r"\.\./\.\./examples/gallery/(\w+)\.py", r"\1.md", markdown) if page.file.src_uri == INDEX else markdown
    )


def _source(name: str) -> str:
    return (SCRIPTS / f"{name}.py").read_text(encoding="utf-8")
