"""Options of methods, as they are typed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from cyclopts.token import Token

from mwdn.cli.method_options import read_options
from mwdn.errors import ParameterError


@dataclass(frozen=True)
class Many:
    """A solver of a plugin, with options of all types."""

    weights: tuple[float, float, float] = (1.0, 1.0, 1.0)
    steps: tuple[int, ...] = ()
    log: Path | None = None
    kind: Literal["a", "b"] | float = "a"
    fast: bool = False


def command():
    """The command that has the options."""


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("weights", "1,2,3.5", (1.0, 2.0, 3.5)),
        ("weights", "[1, 2, 3]", (1.0, 2.0, 3.0)),
        ("steps", "4,5", (4, 5)),
        ("log", "./a.txt", Path("a.txt")),
        ("log", "none", None),
        ("kind", "b", "b"),
        ("kind", "2.5", 2.5),
        ("fast", "true", True),
    ],
)
def test_values_have_the_type_of_the_option(monkeypatch, name, text, value):
    monkeypatch.setattr("mwdn.cli.method_options.SOLVERS", {"many": Many})
    assert read_options(["many"], {name: [Token(value=text)]}, command) == {"many": {name: value}}


@pytest.mark.parametrize(("name", "text"), [("weights", "1,2"), ("steps", "x"), ("kind", "c"), ("fast", "1")])
def test_another_value_is_named(monkeypatch, name, text):
    monkeypatch.setattr("mwdn.cli.method_options.SOLVERS", {"many": Many})
    with pytest.raises(ParameterError, match=f"`--{name}` \\({text}\\) must be"):
        read_options(["many"], {name: [Token(value=text)]}, command)
