"""Hook of the site: the options of each page of docs/commands, from the help of the command.

A line `<!-- options of mwdn NAME -->` of a page becomes the tables. What `mwdn NAME --help` prints is the one source.
"""

import inspect
import re
from collections.abc import Iterable, Sequence
from typing import Any

from cyclopts.help import HelpEntry, HelpPanel
from mkdocs.config.defaults import MkDocsConfig

from mwdn.cli.app import COMMANDS, make_app
from mwdn.cli.as_typed import as_typed
from mwdn.cli.camera import CameraOptions
from mwdn.cli.help_texts import HelpTexts

MARK = re.compile(r"^<!-- options of mwdn ([a-z]+) -->$", re.MULTILINE)
INDEX = "commands/index.md"
"""How to try the examples, and a list of the commands."""

OF_ALL = "Options of every command"
"""Title of the panel that is the same for all; docs/command-line.md has it."""

SWITCHES = {"True": "on", "False": "off"}


class _Collector(HelpTexts):
    """Keeps what the help would print."""

    def __init__(self, command: str) -> None:
        super().__init__(command)
        self.usage = ""
        self.panels: list[HelpPanel] = []

    def render_usage(self, _console: object, _options: object, usage: Any) -> None:  # noqa: ANN401
        self.usage = str(usage).strip().removeprefix("Usage: ")

    def render_description(self, *_: object) -> None:
        """Not needed: `_introduction` has it before it is formatted."""

    def __call__(self, _console: object, _options: object, panel: HelpPanel) -> None:
        self.panels.append(self.panel_as_typed(panel))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the pages to the navigation."""
    pages = [INDEX, *({f"mwdn {name}": f"commands/{name}.md"} for name in sorted(COMMANDS))]
    config.nav = [*(config.nav or []), {"Commands": pages}]
    return config


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the mark of a page by the tables."""
    return MARK.sub(lambda match: describe(match[1]), markdown)


def describe(command: str) -> str:
    """The options of a command as Markdown: how it is called, what its help adds, its own options, the camera's."""
    app = make_app(command)
    kinds = sorted(name for name in app[command] if not name.startswith("-"))
    collected = {kind: _collect(app, command, [command, *kind.split()]) for kind in kinds or [""]}
    parts = ["```text", *(help_.usage for help_ in collected.values()), "```", "", _introduction(app, command)]
    shared = _shared([_entries(help_) for help_ in collected.values()])
    for kind, help_ in collected.items():
        own = [entry for entry in _entries(help_) if kind == "" or _key(entry) not in shared]
        parts += [f"### mwdn {command} {kind}\n\n{app[command][kind].help.partition(chr(10))[0]}\n"] if kind else []
        parts += _tables(own)
    if kinds:
        rest = [entry for entry in _entries(collected[kinds[0]]) if _key(entry) in shared]
        parts += [f"### Options of every kind of {command}", "", *_tables(rest)]
    return "\n".join(parts)


def _collect(app: Any, command: str, words: Sequence[str]) -> _Collector:  # noqa: ANN401
    collector = _Collector(command)
    app.help_formatter = collector
    app.help_print(list(words))
    return collector


def _entries(help_: _Collector) -> list[HelpEntry]:
    return [entry for panel in help_.panels if panel.title != OF_ALL for entry in panel.entries]


def _key(entry: HelpEntry) -> tuple[object, ...]:
    return (*entry.display_labels, entry.default, _text(entry))


def _shared(listed: Sequence[Iterable[HelpEntry]]) -> set[tuple[object, ...]]:
    """Options that all kinds have, with the same meaning and default."""
    return set.intersection(*({_key(entry) for entry in entries} for entries in listed))


def _introduction(app: Any, command: str) -> str:  # noqa: ANN401
    """The help below its first sentence."""
    text = inspect.cleandoc(app[command].help).partition("\n\n")[2]
    options = {name for entry in app[command].assemble_argument_collection() for name in entry.names}
    return as_typed(re.split(r"^(?:Args|Returns|Raises):", text, flags=re.MULTILINE)[0].strip(), options) + "\n"


def _tables(entries: Sequence[HelpEntry]) -> list[str]:
    """A table of the command's own options, and one of those that describe the camera."""
    camera = _camera_options()
    own = [entry for entry in entries if not camera.intersection(entry.positive_names)]
    of_camera = [entry for entry in entries if entry not in own]
    parts = _table(own)
    if len(of_camera) > 1:
        return [*parts, "### The camera and its files", "", *_table(of_camera)]
    return _table(entries)


def _camera_options() -> set[str]:
    """Names of the options that describe the camera."""
    from cyclopts import App

    app = App()

    @app.default
    def command(camera: CameraOptions = CameraOptions()) -> None:
        """Not called."""

    return {name for argument in app.assemble_argument_collection() for name in argument.names}


def _table(entries: Iterable[HelpEntry]) -> list[str]:
    rows = [f"| {_names(entry)} | {_meaning(entry)} |".replace("\n", " ") for entry in entries]
    return ["| option | meaning |", "| --- | --- |", *rows, ""] if rows else ["None.", ""]


def _names(entry: HelpEntry) -> str:
    return ", ".join(f"`{label}`" for label in entry.display_labels_with_metavar).replace("|", r"\|")


def _meaning(entry: HelpEntry) -> str:
    """What the help says: the text, the choices, the default."""
    parts = [_text(entry)]
    if entry.choices:
        parts.append(f"Choices: {', '.join(f'`{choice}`' for choice in entry.choices)}.")
    if entry.required:
        parts.append("Required.")
    elif entry.default not in (None, "()"):
        parts.append(f"Default: {SWITCHES.get(entry.default, f'`{entry.default}`')}.")
    return " ".join(parts).replace("|", r"\|")


def _text(entry: HelpEntry) -> str:
    """Its description, Markdown, on one line."""
    return " ".join(str(getattr(entry.description, "primary_renderable", None).markup).split())
