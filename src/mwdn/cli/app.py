"""The command line, assembled from one file per command."""

import sys
from typing import NoReturn

import cyclopts
from cyclopts import App

from mwdn.cli.benchmark import benchmark
from mwdn.cli.camera import complain, errors
from mwdn.cli.demo import demo
from mwdn.cli.design import design
from mwdn.cli.doctor import doctor
from mwdn.cli.evaluate import evaluate
from mwdn.cli.export import export
from mwdn.cli.import_ import import_
from mwdn.cli.inspect import inspect
from mwdn.cli.methods import methods
from mwdn.cli.reconstruct import reconstruct
from mwdn.cli.train import simulate, train
from mwdn.errors import MwdnError
from mwdn.runtime.memory import keep_memory
from mwdn.version import __version__

app = App(
    name="mwdn",
    version=__version__,
    help="Lensless imaging: reconstruct the scene from the pattern that a thin mask casts on a sensor. Add --debug to "
    "any command for the traceback of an error.",
)
for command in (reconstruct, methods, design, inspect, simulate, train, export, benchmark, evaluate, demo, doctor):
    app.command(command)
app.command(import_, name="import")


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit: 0 on success, 1 if some captures failed, 2 for a wrong call."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    keep_memory()
    try:
        result = app([a for a in arguments if a != "--debug"], exit_on_error=False, print_error=True)
    except cyclopts.CycloptsError:
        sys.exit(2)
    except MwdnError as error:
        if debug:
            errors.print_exception()
        complain("[bold red]Error:[/]", error)
        sys.exit(2)
    sys.exit(result if isinstance(result, int) else 0)
