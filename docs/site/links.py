"""Hook of the site: files of the repository that pages link to, such as `../benchmarks/results/admm.json`.

A page's relative links work on GitHub. On the site the folder above `docs/` does not exist, so each file there that a
page links to becomes a file of the site, `repository/PATH`: a page if it is Markdown, as it is otherwise. Links between
them are rewritten. A link to a file that does not exist stays, and the strict build reports it.
"""

import logging
import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FOLDER = "repository"
LINK = re.compile(r"(\]\()([^)\s#:]+)((?:#[^)\s]*)?\))")
"""A relative link or picture of Markdown: what is before its address, the address, and its anchor."""

ELSEWHERE = re.compile(r"""<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)=["']?((?:https?:)?//[^"'\s>]+)""")
"""The address of a script, style, font or picture that is not of this site."""

ALWAYS = ("CONTRIBUTING.md", "CHANGELOG.md")
"""Pages of the navigation, whether or not another page links to them."""


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add every file outside `docs/` that a page links to, and those that these link to."""
    waiting = [Path(file.abs_src_path) for file in files.documentation_pages() if file.abs_src_path]
    waiting += [_add(files, config, ROOT / name) for name in ALWAYS]
    while waiting:
        page = waiting.pop()
        for _, address, _ in LINK.findall(page.read_text(encoding="utf-8")):
            target = (page.parent / address).resolve()
            outside = target.is_file() and target.is_relative_to(ROOT) and not target.is_relative_to(DOCS)
            if outside and files.get_file_from_path(_site_path(target)) is None:
                _add(files, config, target)
                waiting += [target] if target.suffix == ".md" else []
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite the links of a page to files outside `docs/`, and all links of a page from there."""
    source = Path(page.file.abs_src_path or DOCS)
    here = Path(page.file.src_uri).parent

    def on_site(match: re.Match[str]) -> str:
        before, address, after = match.groups()
        target = (source.parent / address).resolve()
        path = _site_path(target) if target.is_relative_to(ROOT) else ""
        if files.get_file_from_path(path) is None:
            return match[0]
        return f"{before}{os.path.relpath(path, here).replace(os.sep, '/')}{after}"

    return LINK.sub(on_site, markdown)


def on_page_content(html: str, **_: object) -> str:
    r"""GitHub needs `\|` for a bar in the code of a table; Python-Markdown keeps the backslash."""
    return re.sub(r"<td>.*?</td>", lambda cell: cell[0].replace(r"\|", "|"), html)


def on_post_page(output: str, *, page: Page, **_: object) -> str:
    """Report what the page would load from elsewhere: the site must work without a network."""
    for address in ELSEWHERE.findall(output):
        logging.getLogger("mkdocs.hooks.links").warning("%s loads %s", page.file.src_uri, address)
    return output


def _add(files: Files, config: MkDocsConfig, path: Path) -> Path:
    files.append(File.generated(config, _site_path(path), abs_src_path=str(path)))
    return path


def _site_path(path: Path) -> str:
    """Path within the site of a file of the repository."""
    inside = path.is_relative_to(DOCS)
    return path.relative_to(DOCS).as_posix() if inside else f"{FOLDER}/{path.relative_to(ROOT).as_posix()}"
