"""Options that a command must know were given; imported with the command line, so without torch."""

from typing import Any

from cyclopts import App
from cyclopts.token import Token


def note_given(app: App, commands: tuple[str, ...], arguments: Any) -> None:  # noqa: ANN401
    """Switch off the hidden options ``--auto-bin`` and ``--auto-background`` if ``--bin`` or ``--background`` is given.

    They may have their defaults. A camera file gives a bin, too; its background may have been chosen automatically.
    """
    by_name = {argument.name: argument for argument in arguments}
    for name, sources in (("bin", None), ("background", ("cli",))):
        automatic, given = by_name.get(f"--auto-{name}"), by_name.get(f"--{name}")
        tokens = [] if given is None else [each for each in given.tokens if sources is None or each.source in sources]
        if automatic is not None and not automatic.tokens and tokens:
            automatic.append(Token(keyword=f"--auto-{name}", value="false", source=f"--{name}"))
