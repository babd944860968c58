"""Hook of the site: pictures get captions, and table cells with much text a least width, for narrow screens."""

import re

PICTURES = re.compile(r"<p>((?:\s*<img [^>]*/?>\s*)+)</p>")
PICTURE = re.compile(r"<img [^>]*>")
ALTERNATIVE = re.compile(r' alt="([^"]*)"')
CELL = re.compile(r"<td>(.*?)</td>", re.DOTALL)
LONG = 40
"""Characters of a cell from which it gets a least width: a table that does not fit then scrolls."""


def on_page_content(html: str, **_: object) -> str:
    """Pictures in a paragraph of their own become figures side by side; each one's alternative text is its caption."""
    return CELL.sub(_cell, PICTURES.sub(_figures, html))


def _figures(match: re.Match[str]) -> str:
    figures = []
    for picture in PICTURE.findall(match[1]):
        text = found[1] if (found := ALTERNATIVE.search(picture)) else ""
        figures.append(f"<figure>{picture}<figcaption>{text[:1].upper()}{text[1:]}</figcaption></figure>")
    return f'<div class="figures">{"".join(figures)}</div>'


def _cell(match: re.Match[str]) -> str:
    is_long = len(re.sub(r"<[^>]*>", "", match[1])) >= LONG
    return f'<td class="long">{match[1]}</td>' if is_long else match[0]
