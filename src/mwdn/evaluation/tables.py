"""Convert a rich table to HTML or Markdown."""

import html
from collections.abc import Callable

from rich.table import Table
from rich.text import Text


def html_table(table: Table) -> str:
    """A ``<table>`` with the title as caption; bold cells and the alignment of columns are kept."""
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
    """A Markdown table, with the title in italics above it."""
    heads = [_escape_pipes(str(column.header)) for column in table.columns]
    rules = ["---:" if column.justify == "right" else "---" for column in table.columns]
    rows = [heads, rules, *_rows(table, _escape_pipes, lambda text: f"**{text}**")]
    title = f"*{table.title}*\n\n" if table.title else ""
    return title + "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _escape_pipes(text: str) -> str:
    return text.replace("|", "\\|")


def _rows(table: Table, escape: Callable[[str], str], bold: Callable[[str], str]) -> list[list[str]]:
    columns = [[_with_bold(cell, escape, bold) for cell in column.cells] for column in table.columns]
    return [list(row) for row in zip(*columns, strict=True)]


def _with_bold(cell: object, escape: Callable[[str], str], bold: Callable[[str], str]) -> str:
    text = cell if isinstance(cell, Text) else Text.from_markup(str(cell))
    result, end = "", 0
    for span in sorted(text.spans):
        result += escape(text.plain[end : span.start]) + bold(escape(text.plain[span.start : span.end]))
        end = span.end
    return result + escape(text.plain[end:])
