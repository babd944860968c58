"""Options that a command must know were given; imported with the command line, so without torch."""

from typing import Any

from cyclopts import App
from cyclopts.token import Token


def note_given(app: App, commands: tuple[str, ...], arguments: Any) -> None:  # noqa: ANN401
    """Switch off the hidden option ``--auto-bin`` if ``--bin`` is given, be it the default; so for ``--background``."""
    by_name = {argument.name: argument for argument in arguments}
    for name in ("bin", "background"):
        automatic, given = by_name.get(f"--auto-{name}"), by_name.get(f"--{name}")
        if automatic is not None and not automatic.tokens and given is not None and given.tokens:
            automatic.append(Token(keyword=f"--auto-{name}", value="false", source=f"--{name}"))
