"""Options of every command, for its help and for the shell's completion; `mwdn.cli.app.main` acts on them."""

from typing import Annotated

from cyclopts import App, Group, Parameter

GLOBAL = {"--quiet": "-q", "--verbose": "-v", "--debug": "--debug"}
"""Options of all commands, and their short forms."""

_SHARED = Parameter(group=Group("Options of every command"), negative=(), show_default=False)


def add_global_options(app: App) -> None:
    """Let the help and the completion of each command name the global options."""

    @app.meta.default
    def every_command(
        *_: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        quiet: Annotated[bool, _SHARED, Parameter(name=["--quiet", "-q"])] = False,
        verbose: Annotated[bool, _SHARED, Parameter(name=["--verbose", "-v"])] = False,
        debug: Annotated[bool, _SHARED] = False,
    ) -> None:
        """Not called.

        Args:
            quiet: print only errors and what was asked for.
            verbose: also print versions, times and what was assumed.
            debug: also print the traceback of an error.
        """
