"""Methods that a client may name: solvers with their numbers, and the bundled networks. No path is a method here."""

from typing import Any, get_args, get_origin

from mwdn.errors import ParameterError, UnknownNameError, type_in_words
from mwdn.inference.method_options import list_options, summary
from mwdn.solvers import SOLVERS
from mwdn.weights.bundled import BUNDLED

KINDS = (int, float)
RANGES = {"regularisation": (1e-7, 1.0), "iterations": (1, 500)}
"""Useful values of options, for sliders; the first is logarithmic."""

_NETWORKS = {
    "universal": "Network for any camera, with alignment and plug-and-play ADMM: the best pictures.",
    "universal-small": "The faster network for any camera.",
}


def list_methods() -> list[dict[str, Any]]:
    """For JSON: each method with its description and options."""
    networks = [{"name": name, "kind": "network", "about": _NETWORKS.get(name, ""), "options": []} for name in BUNDLED]
    solvers = [
        {"name": name, "kind": "solver", "about": summary(solver), "options": _options(name)}
        for name, solver in SOLVERS.items()
    ]
    return [*networks, *solvers]


def _options(name: str) -> list[dict[str, Any]]:
    listed = []
    for option in list_options(SOLVERS[name]):
        if option.type not in KINDS and not _is_number(option.type):
            continue
        low, high = RANGES.get(option.name, (None, None))
        entry = {"name": option.name, "type": type_in_words(option.type), "default": option.default}
        listed.append({**entry, "about": option.meaning, "low": low, "high": high})
    return listed


def _is_number(kind: Any) -> bool:  # noqa: ANN401
    """Whether a type allows a number beside others, such as ``float | None``."""
    return get_origin(kind) is not None and any(part in KINDS for part in get_args(kind))


def checked_options(name: str, options: dict[str, Any]) -> dict[str, Any]:
    """Check that a method may be used, and that it has these options; JSON's 1 for a float becomes 1.0.

    Raises:
        UnknownNameError: no such method or option.
        ParameterError: an option is no number.
    """
    if name not in BUNDLED and name not in SOLVERS:
        raise UnknownNameError("method", name, [*BUNDLED, *SOLVERS])
    known = {option["name"]: option["type"] for option in _options(name)} if name in SOLVERS else {}
    for option, value in options.items():
        if option not in known:
            raise UnknownNameError(f"option of method '{name}'", option, known)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ParameterError(f"`{option}` ({value!r}) of the method must be a number.")
    return {option: value if "whole" in known[option] else float(value) for option, value in options.items()}
