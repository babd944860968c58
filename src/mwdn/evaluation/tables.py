"""A table of the terminal on a page: the same cells as HTML or Markdown."""

import html
from collections.abc import Callable

from rich.table import Table
from rich.text import Text


def html_table(table: Table) -> str:
    """A ``<table>`` with its title as caption; what is bold stays bold, and columns keep their side."""
    rows = _rows(table, html.escape, lambda text: f"<b>{text}</b>")
    styles = ["" if column.justify == "right" else ' class="left"' for column in table.columns]
    heads = "".join(
        f"<th{style}>{html.escape(str(column.header))}</th>"
        for column, style in zip(table.columns, styles, strict=True)
    )
    lines = "".join(
        f"<tr><th>{first}</th>{''.join(f'<td{s}>{cell}</td>' for cell, s in zip(rest, styles[1:], strict=True))}</tr>"
        for first, *rest in rows
    )
    title = f"<caption>{html.escape(str(table.title))}</caption>" if table.title else ""
    return f"<table>{title}<tr>{heads}</tr>{lines}</table>"


def markdown_table(table: Table) -> str:
    """A Markdown table, its title in italics above it."""
    heads = [_unpiped(str(column.header)) for column in table.columns]
    rules = ["---:" if column.justify == "right" else "---" for column in table.columns]
    rows = [heads, rules, *_rows(table, _unpiped, lambda text: f"**{text}**")]
    title = f"*{table.title}*\n\n" if table.title else ""
    return title + "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _unpiped(text: str) -> str:
    return text.replace("|", "\\|")


def _rows(table: Table, escape: Callable[[str], str], bold: Callable[[str], str]) -> list[list[str]]:
    columns = [[_styled(cell, escape, bold) for cell in column.cells] for column in table.columns]
    return [list(row) for row in zip(*columns, strict=True)]


def _styled(cell: object, escape: Callable[[str], str], bold: Callable[[str], str]) -> str:
    text = cell if isinstance(cell, Text) else Text.from_markup(str(cell))
    found, end = "", 0
    for span in sorted(text.spans):
        found += escape(text.plain[end : span.start]) + bold(escape(text.plain[span.start : span.end]))
        end = span.end
    return found + escape(text.plain[end:])
