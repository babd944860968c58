"""Output to the terminal, by what it is: set for each command by --quiet, --verbose and --json."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from mwdn.errors import MwdnError, one_line


class _Console(Console):
    """A console that lets `mwdn.cli.signals` end the command when nobody reads its output any more."""

    def on_broken_pipe(self) -> None:
        """Pass the error on."""
        raise


results = _Console()
"""What the command is asked for, such as a table: always."""

console = _Console()
"""What the command has done: not with --quiet; with --json on standard error."""

notes = _Console(stderr=True)
"""Warnings, remarks and progress: not with --quiet."""

details = _Console(stderr=True, quiet=True)
"""Versions, times, and what was assumed: only with --verbose."""

errors = _Console(stderr=True)
"""Errors: always."""

Json = Annotated[bool, Parameter(negative=())]
"""Type of the option --json, see `set_up`."""

_spell: Callable[[str], str] = str


def set_up(
    *, quiet: bool = False, verbose: bool = False, json: bool = False, spell: Callable[[str], str] = str
) -> None:
    """Set what is printed, and where.

    Args:
        quiet: print errors and what was asked for, nothing else.
        verbose: print versions, times, and what was assumed, too.
        json: keep standard output free for one JSON document.
        spell: converts messages of the library to the words of the running command, see `mwdn.cli.as_typed`.
    """
    global _spell
    console.quiet = notes.quiet = quiet
    details.quiet = not verbose
    console.stderr = json
    _spell = spell


def print_json(content: Any) -> None:  # noqa: ANN401
    """Print a JSON document to standard output."""
    from json import dumps

    results.out(dumps(content, indent=2, allow_nan=False), highlight=False)


def say(*sentences: str) -> None:
    """Print sentences about what the command has done, each on one line."""
    for sentence in sentences:
        console.print(one_line(sentence), markup=False, highlight=False, soft_wrap=True)


def detail(*sentences: str) -> None:
    """Print sentences for --verbose, each on one line."""
    for sentence in sentences:
        details.print(escape(one_line(sentence)), style="dim", highlight=False, soft_wrap=True)


def note(*sentences: str) -> None:
    """Print sentences that are neither results nor warnings, each on one line."""
    for sentence in sentences:
        notes.print(escape(one_line(sentence)), highlight=False, soft_wrap=True)


def warn(*warnings: str | None) -> None:
    """Print each warning that is not ``None``, on one line."""
    for warning in filter(None, warnings):
        text = escape(_spell(one_line(" ".join(warning.split()))))
        notes.print(f"[yellow]Warning:[/] {text}", highlight=False, soft_wrap=True)


def complain(start: str, error: MwdnError) -> None:
    """Print an error on one line: brackets are not markup, and paths are not wrapped at the terminal's width."""
    errors.print(f"{start} {escape(_spell(str(error)))}", highlight=False, soft_wrap=True)


def quoted(path: Path) -> str:
    """A path as a shell takes it."""
    return shlex.quote(str(path))


def counted(count: int, noun: str) -> str:
    """A number of things in words: "1 pair", "2,000 pairs"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


@contextmanager
def if_interrupted(message: Callable[[], str]) -> Iterator[None]:
    """Let Ctrl-C end the command with a message that says what is kept and how to go on."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(str(interrupt) or message()) from interrupt


def all_or_nothing(pairs: Path) -> AbstractContextManager[None]:
    """`if_interrupted` while a file of pairs is written, which appears when it is complete."""
    return if_interrupted(lambda: f"Interrupted. Nothing is kept: {pairs} is written when all pairs are done.")
