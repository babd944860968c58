"""Pages of text, tables and pictures, written as one HTML file and as Markdown."""

import base64
import html
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from rich.table import Table

from mwdn.evaluation.tables import html_table, markdown_table
from mwdn.io.files import atomic_write, write_text


@dataclass(frozen=True)
class Picture:
    """An encoded picture.

    Args:
        name: file name, ending in .png or .jpg.
        content: bytes of the file.
        words: what the picture shows.
    """

    name: str
    content: bytes
    words: str


@dataclass(frozen=True)
class Code:
    """Preformatted text."""

    text: str


Block = str | Table | Picture | Code


@dataclass(frozen=True)
class Section:
    """A heading and the blocks under it."""

    title: str
    blocks: list[Block]


_HTML = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 88rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
nav a {{ margin-right: 1rem; }} img {{ max-width: 100%; }} div.wide {{ overflow-x: auto; margin: 1rem 0; }}
table {{ border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; white-space: nowrap; }}
caption {{ text-align: left; color: #555; padding-bottom: .3rem; }}
td, th {{ padding: .15rem .8rem; text-align: right; border-bottom: 1px solid #e4e4e4; font-weight: normal; }}
tr:first-child th {{ border-bottom: 1px solid #888; }} th:first-child, .left {{ text-align: left; }}
b {{ color: #06540c; }}
pre {{ background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: 12px; }}
</style>
<h1>{title}</h1>
<nav>{links}</nav>
{body}
</html>
"""


MARK = b'<nav><a href="#s0">'
"""What every such page begins with, and hardly any other."""


def write_html(path: Path, title: str, sections: list[Section]) -> None:
    """Write a self-contained HTML page, atomically."""
    links = "".join(f'<a href="#s{i}">{html.escape(section.title)}</a> ' for i, section in enumerate(sections))
    body = "\n".join(
        f'<h2 id="s{i}">{html.escape(section.title)}</h2>\n' + "\n".join(map(_as_html, section.blocks))
        for i, section in enumerate(sections)
    )
    write_text(path, _HTML.format(title=html.escape(title), links=links, body=body))


def write_markdown(path: Path, title: str, sections: list[Section]) -> None:
    """Write a Markdown page and its pictures, in the folder ``pictures`` beside it, each atomically."""
    parts = [f"# {title}"]
    for section in sections:
        parts.append(f"## {section.title}")
        for block in section.blocks:
            if isinstance(block, Picture):
                with atomic_write(path.parent / "pictures" / block.name) as temporary:
                    temporary.write_bytes(block.content)
            parts.append(_as_markdown(block))
    write_text(path, "\n\n".join(parts) + "\n")


def _as_html(block: Block) -> str:
    match block:
        case Table():
            return f'<div class="wide">{html_table(block)}</div>'
        case Picture():
            kind = "jpeg" if block.name.endswith(".jpg") else "png"
            data = base64.b64encode(block.content).decode("ascii")
            return f'<p><img src="data:image/{kind};base64,{data}" alt="{html.escape(block.words)}"></p>'
        case Code():
            return f"<pre>{html.escape(block.text)}</pre>"
    return f"<p>{html.escape(block)}</p>"


def _as_markdown(block: Block) -> str:
    match block:
        case Table():
            return markdown_table(block)
        case Picture():
            return f"![{block.words}](pictures/{quote(block.name)})"
        case Code():
            return f"```\n{block.text}\n```"
    return block
