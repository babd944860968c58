"""Public weights of metrics: downloaded only if the user says so."""

import sys

from rich.prompt import Confirm

from mwdn.cli.terminal import notes
from mwdn.evaluation.alexnet import download_mebibytes
from mwdn.io.files import cache_folder


def ask_for_lpips(lpips: bool | None, alexnet: str = "", heads: str = "") -> bool | None:
    """The option --lpips; if it is not given and weights are missing, a terminal asks whether to download them.

    Args:
        lpips: True to download missing weights, False to do without, ``None`` if the option is not given.
        alexnet: file of AlexNet's weights, if one is named.
        heads: file of the heads of LPIPS, if one is named.

    Returns:
        ``lpips``, or True after a yes.
    """
    size = download_mebibytes(alexnet, heads)
    if lpips is not None or size == 0 or notes.quiet or not (sys.stdin.isatty() and notes.is_interactive):
        return lpips
    question = f"LPIPS and feature MSE need public weights. Download {size} MiB to {cache_folder()}, once?"
    try:
        return Confirm.ask(question, console=notes, default=False) or None
    except EOFError:  # Ctrl-D
        return None
