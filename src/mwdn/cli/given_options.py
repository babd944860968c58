"""Options that a command must know were given; imported with the command line, so without torch."""

from typing import Any

from cyclopts import App
from cyclopts.token import Token


def note_given(app: App, commands: tuple[str, ...], arguments: Any) -> None:  # noqa: ANN401
    """Switch off the hidden options ``--auto-bin`` and ``--auto-background`` if ``--bin`` or ``--background`` is given.

    They may have their defaults. A camera file gives a bin, too; its background may have been chosen automatically.
    """
    by_name = {argument.name: argument for argument in arguments}
    for name in ("bin", "background"):
        automatic, given = by_name.get(f"--auto-{name}"), by_name.get(f"--{name}")
        is_given = given is not None and any(name == "bin" or token.source == "cli" for token in given.tokens)
        if automatic is not None and not automatic.tokens and is_given:
            automatic.append(Token(keyword=f"--auto-{name}", value="false", source=f"--{name}"))
