"""Methods that a client may name: solvers with their numbers, and the bundled networks. No path is a method here."""

from types import NoneType
from typing import Any, get_args, get_origin

from mwdn.arguments import type_in_words
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.inference.method_options import REQUIRED, Option, list_options, summary
from mwdn.io.toml import check_numbers
from mwdn.solvers import SOLVERS
from mwdn.weights.bundled import BUNDLED

RANGES = {"regularisation": (1e-7, 1.0), "iterations": (1, 500)}
"""Useful values of options, for sliders; the first is logarithmic."""


def list_methods() -> list[dict[str, Any]]:
    """For JSON: each method with its description and options."""
    networks = [
        {"name": name, "kind": "network", "about": description, "options": []} for name, description in BUNDLED.items()
    ]
    solvers = [
        {"name": name, "kind": "solver", "about": summary(solver), "options": _options(name)}
        for name, solver in SOLVERS.items()
    ]
    return [*networks, *solvers]


def _options(name: str) -> list[dict[str, Any]]:
    listed = []
    for option in _numbers(name):
        low, high = RANGES.get(option.name, (None, None))
        default = None if option.default is REQUIRED else option.default
        entry = {"name": option.name, "type": type_in_words(option.type), "default": default}
        listed.append({**entry, "about": option.meaning, "low": low, "high": high})
    return listed


def _numbers(name: str) -> list[Option]:
    """Options of a solver that are numbers, or may be, such as ``float | None``."""
    return [option for option in list_options(SOLVERS[name]) if _kinds(option.type) & {int, float}]


def _kinds(kind: Any) -> set[Any]:  # noqa: ANN401
    return {kind} if get_origin(kind) is None else {*get_args(kind)}


def checked_options(name: str, options: dict[str, Any]) -> dict[str, Any]:
    """Check that a method may be used, and that it has these options; JSON's 1 for a float becomes 1.0.

    Raises:
        UnknownNameError: no such method or option.
        ParameterError: an option is no number.
    """
    if name not in BUNDLED and name not in SOLVERS:
        raise UnknownNameError("method", name, [*BUNDLED, *SOLVERS])
    known = {option.name: option.type for option in _numbers(name)} if name in SOLVERS else {}
    for option, value in options.items():
        if option not in known:
            raise UnknownNameError(f"option of method '{name}'", option, known)
        if value is None and NoneType in _kinds(known[option]):
            continue  # the method chooses
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ParameterError(f"`{option}` ({value!r}) of the method must be a number.")
        check_numbers(value, option)
    return {
        option: value if value is None or int in _kinds(known[option]) else float(value)
        for option, value in options.items()
    }
