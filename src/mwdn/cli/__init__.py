"""The command line: one file per command."""

from mwdn.cli.app import main

__all__ = ["main"]
