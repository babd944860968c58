"""Options of solvers and networks, read from their signatures and docstrings."""

import inspect
import re
from collections.abc import Callable
from typing import Any, NamedTuple

REQUIRED = inspect.Parameter.empty
"""Default of an option that must be given."""


class Option(NamedTuple):
    """A keyword argument of a solver or network.

    Args:
        name: of the argument.
        type: as annotated; without an annotation that of the default, or `Any`.
        default: its value unless given; `REQUIRED` if it has none.
        meaning: its entry in the docstring.
    """

    name: str
    type: Any
    default: Any
    meaning: str


def list_options(method: Callable[..., Any]) -> list[Option]:
    """Keyword arguments of the class of a solver or network."""
    meanings = _docstring_arguments(inspect.getdoc(method) or "")
    return [
        Option(name, _type(parameter), parameter.default, meanings.get(name, ""))
        for name, parameter in inspect.signature(method).parameters.items()
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    ]


def _type(parameter: inspect.Parameter) -> Any:  # noqa: ANN401
    if parameter.annotation is not parameter.empty:
        return parameter.annotation
    return Any if parameter.default in (REQUIRED, None) else type(parameter.default)


def _docstring_arguments(docstring: str) -> dict[str, str]:
    """Entries of a Google-style Args section, each as one line; code is in single backticks, as in messages."""
    section = re.search(r"^Args:\n((?: +.*\n?|\n)*)", docstring, re.MULTILINE)
    entries = re.findall(r"^ {4}(\w+): (.*(?:\n {5,}.*)*)", section[1], re.MULTILINE) if section else []
    return {name: " ".join(text.split()).replace("``", "`") for name, text in entries}


def summary(method: Callable[..., Any]) -> str:
    """First line of a docstring; code is in single backticks."""
    return (inspect.getdoc(method) or "").partition("\n")[0].replace("``", "`")
