"""`mwdn explain`: what a doubt means and what to do about it, from the guide that comes with the package."""

import re
from pathlib import Path

from rich.markdown import Markdown
from rich.table import Table

from mwdn.cli.terminal import results
from mwdn.errors import UnknownNameError

GUIDE = Path(__file__).with_name("troubleshooting.md")
"""docs/troubleshooting.md, here by a link; a wheel has a copy."""


def sections(text: str) -> dict[str, str]:
    """The sections of the guide that explain one topic each, by topic: their headings are one word in lower case."""
    parts = re.split(r"^## (.+)\n", text, flags=re.MULTILINE)
    return {
        topic: section.strip()
        for topic, section in zip(parts[1::2], parts[2::2], strict=True)
        if re.fullmatch("[a-z-]+", topic)
    }


def explain(topic: str | None = None, /) -> None:
    """Explain a doubt of another command: what it means, its cause, and what to do.

    Args:
        topic: the word that the doubt names, such as gamma; all topics are listed unless given.
    """
    # The pages that links lead to, and pictures, are not in the package.
    text = re.sub(r"!?\[([^]]*)\]\((?!http)[^)]*\)", r"\1", GUIDE.read_text(encoding="utf-8"))
    topics = sections(text)
    if topic is None:
        table = Table("topic", "symptom")
        for name, section in topics.items():
            symptom = section.removeprefix("**Symptom**:").partition("**Cause**")[0]
            table.add_row(name, " ".join(symptom.split()))
        results.print(table, markup=False)
        return
    if topic not in topics:
        raise UnknownNameError("topic", topic, topics)
    results.print(Markdown(f"## {topic}\n\n{topics[topic]}"))
