"""The command line, one file a command."""

from mwdn.cli.app import main

__all__ = ["main"]
