"""`mwdn methods`: the reconstruction methods and their options."""

from typing import Any

from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from mwdn.arguments import type_in_words
from mwdn.cli.terminal import results
from mwdn.errors import UnknownNameError
from mwdn.inference.method_options import REQUIRED, Option, list_options, summary
from mwdn.networks import NETWORKS
from mwdn.solvers import SOLVERS
from mwdn.weights.bundled import BUNDLED, find_weights
from mwdn.weights.checkpoint import read_metadata


def methods(name: str | None = None, /) -> None:
    """List the reconstruction methods, or the options of one.

    Args:
        name: of a solver, a bundled network or a network type; all methods are listed unless given.
    """
    if name is None:
        results.print(_overview())
        return
    if not any(name in names for names in (BUNDLED, SOLVERS, NETWORKS)):
        raise UnknownNameError("method", name, {*SOLVERS, *BUNDLED, *NETWORKS})
    if name in SOLVERS:  # `wiener` is a solver and a network type
        options = list_options(SOLVERS[name])
        objects = [option for option in options if "`" in type_in_words(option.type)]  # `Penalties`
        _print(f"Solver {name}. Options, as --name value:", [option for option in options if option not in objects])
        if objects:
            _print("In Python only:", objects)
    if name in BUNDLED:
        metadata = read_metadata(find_weights(name) or name)
        options = [
            option._replace(default=metadata["options"].get(option.name, option.default))
            for option in list_options(NETWORKS[metadata["name"]])
        ]
        _print(f"Bundled network {name}, a {metadata['name']}. Options, fixed by its training:", options)
    if name in NETWORKS:
        _print(f"Network type {name}. Options, for [network] of a training recipe:", list_options(NETWORKS[name]))


def _overview() -> Table:
    table = Table("name", "kind", "description")
    for name, solver in SOLVERS.items():
        table.add_row(name, "solver", escape(summary(solver)))
    for name, description in BUNDLED.items():
        table.add_row(name, "bundled network", description)
    for name, network in NETWORKS.items():
        table.add_row(name, "network type, to be trained", escape(summary(network)))
    return table


def _print(title: str, options: list[Option]) -> None:
    results.print(title, style="bold", markup=False, highlight=False)
    for name, annotation, default, meaning in options:
        line = f"[bold cyan]{name}[/]: {escape(type_in_words(annotation))}"
        line += ", required" if default is REQUIRED else f" = {escape(_short(default))}"
        results.print(Padding(line, (0, 2)), highlight=False)
        results.print(Padding(escape(meaning), (0, 6)), highlight=False)


def _short(value: Any, length: int = 60) -> str:  # noqa: ANN401
    text = str(value)
    return text if len(text) <= length else f"{text[: length - 3]}..."
