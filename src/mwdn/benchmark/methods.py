"""Methods of a benchmark: the rows of its tables."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from inspect import signature
from typing import Any

from mwdn.arguments import check_options
from mwdn.errors import ParameterError, UnknownNameError, shown
from mwdn.io.toml import check_table, named_table, to_dataclass
from mwdn.networks import NETWORKS
from mwdn.training.recipe import Schedule

MEAN = "mean picture"
"""Label of the row that is the mean of all training scenes."""


@dataclass(frozen=True)
class Method:
    """One row of the tables.

    Args:
        label: its name in the tables.
        name: of the network or solver, or of a bundled network among the solvers.
        options: to build it with.
        learned: whether it is a network to be trained.
        schedule: keys of [schedule] with other values for this network, such as its seed.
    """

    label: str
    name: str
    options: dict[str, Any]
    learned: bool
    schedule: dict[str, Any] = field(default_factory=dict)


def read_methods(
    table: str, content: dict[str, Any], registry: Mapping[str, Any], shared: dict[str, Any]
) -> list[Method]:
    """Methods of a table with lines such as ``mwdn = {}`` and ``average = { name = "mwdn", psf_pooling = "average" }``.

    Args:
        table: networks or solvers.
        content: of the table.
        registry: classes by name.
        shared: options for every method that has them; a method's own line takes precedence.
    """
    methods = []
    for label, line in content.items():
        if not isinstance(line, dict):
            raise ParameterError(f"`{label}` of [{table}] ({line!r}) must be a table of options: `{label} = {{}}`.")
        name = line.get("name", label)
        if not isinstance(name, str) or name not in registry:
            raise UnknownNameError(table.removesuffix("s"), str(name), registry)
        options = {key: value for key, value in line.items() if key not in ("name", "schedule")}
        schedule = check_table(line.get("schedule", {}) if table == "networks" else {}, f"{table}.{label}.schedule")
        to_dataclass(Schedule, f"{table}.{label}.schedule", schedule)
        check_options(registry[name], f"'{name}'", options)
        if table == "solvers":  # a number outside its range is found before anything is trained
            with named_table(f"{table}.{label}"):
                registry[name](**options)
        parameters = signature(registry[name]).parameters
        common = {key: value for key, value in shared.items() if key in parameters}
        methods.append(Method(label, name, {**common, **options}, table == "networks", schedule))
    return methods


def check_name(name: str) -> None:
    """Raise a `ParameterError` unless a label can be the name of a folder."""
    if not re.fullmatch(r"[\w+()=, -][\w.+()=, -]{0,99}", name):
        raise ParameterError(
            f"The label of a method or data set ({shown(name)}) becomes the name of a folder: it must be 1 to 100 "
            "letters, digits, spaces and `_-+.,=()`, and not begin with a dot."
        )


def scale_width(method: Method, factor: float) -> Method:
    """A network with its default width times a factor, unless the recipe gives its width."""
    if not factor > 0:
        raise ParameterError(f"`width_factor` ({factor}) must be positive.")
    width = signature(NETWORKS[method.name]).parameters.get("width") if method.learned else None
    if factor == 1 or width is None or "width" in method.options:
        return method
    return replace(method, options={**method.options, "width": max(1, round(factor * width.default))})
