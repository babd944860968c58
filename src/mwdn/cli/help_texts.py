"""Help of a command, with options as the user types them: `psf_gamma` is `--psf-gamma`.

The texts are docstrings, also of classes of the library, whose fields are options of the commands.
"""

from collections.abc import Collection
from typing import Any

from cyclopts.help import DefaultFormatter, HelpEntry, HelpPanel, InlineText
from rich.console import Console, ConsoleOptions

from mwdn.cli.as_typed import as_typed

CHOOSES_BIN = ("reconstruct", "calibrate")
"""Commands that choose the bin, or leave it to others to choose, unless ``--bin`` is given."""


class HelpTexts(DefaultFormatter):
    """Formatter of the help.

    Args:
        command: whose help it is.
    """

    def __init__(self, command: str) -> None:
        super().__init__()
        self._chooses_bin = command in CHOOSES_BIN

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print one panel: the options, or the arguments."""
        super().__call__(console, options, self.panel_as_typed(panel))

    def panel_as_typed(self, panel: HelpPanel) -> HelpPanel:
        """The panel with the texts that are printed."""
        own = {name for entry in panel.entries for name in entry.names}
        return panel.copy(entries=[self._as_typed(entry, own) for entry in panel.entries])

    def _as_typed(self, entry: HelpEntry, own: Collection[str]) -> HelpEntry:
        from rich.markdown import Markdown  # takes 0.1 s

        default = "chosen" if self._chooses_bin and "--bin" in entry.names else entry.default
        text: Any = getattr(entry.description, "primary_renderable", None)
        if not isinstance(text, Markdown):
            return entry.copy(default=default)
        return entry.copy(default=default, description=InlineText.from_format(as_typed(text.markup, own), "markdown"))
