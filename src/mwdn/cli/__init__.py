"""The command line: one file per command."""

import os
import sys
from typing import NoReturn

from mwdn.cli.openmp import sleep_soon
from mwdn.cli.signals import ended_by_signals
from mwdn.version import __version__


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit, see `mwdn.cli.app.main`."""
    arguments = sys.argv[1:] if arguments is None else arguments
    sleep_soon(os.environ)
    with ended_by_signals(arguments):
        if arguments == ["--version"]:  # without the command line's parser
            print(__version__, flush=True)
            sys.exit()
        from mwdn.cli import app  # takes a quarter of a second

        app.main(arguments)


__all__ = ["main"]
