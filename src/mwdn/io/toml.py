"""TOML from a file or the command line, and dataclasses built from its tables."""

import dataclasses
import json
import math
import re
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from mwdn.arguments import type_in_words
from mwdn.errors import MwdnError, ParameterError, UnknownNameError, reason, shown
from mwdn.io.reading import read_text

T = TypeVar("T")

RECIPES = Path(__file__).parents[1] / "recipes"
"""Folder of the recipes that come with the package."""


_PARTS = 100
"""Most parts of a dotted key."""

_TEXT = re.compile(r"""\"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|#[^\n]*""")
"""Text in quotes on one line, and comments."""


MAX_NUMBER = 1e9
"""Largest number in a table: its square is far within float32, in which samples are simulated."""


def packaged_recipes() -> list[str]:
    """Names of the recipes that come with the package."""
    return sorted(path.stem for path in RECIPES.glob("*.toml"))


def find_recipe(recipe: str | Path) -> Path:
    """File of a recipe.

    Args:
        recipe: path of a TOML file, or the name of a recipe of the package, such as ``quick-cpu``.

    Raises:
        ParameterError: no file has this path.
        UnknownNameError: no recipe has this name.
    """
    path = Path(recipe)
    if path.is_file() or (path.suffix == ".toml" and path.exists()):  # a pipe is refused when it is read
        return path
    if path.name != str(path) or path.suffix:
        hint = f" The recipe of the package is `{path.stem}`." if path.stem in packaged_recipes() else ""
        raise ParameterError(f"The recipe `{path}` does not exist.{hint} See `mwdn recipes`.")
    if str(path) not in packaged_recipes():
        raise UnknownNameError("recipe", str(path), packaged_recipes())
    return RECIPES / f"{path}.toml"


def read_toml(path: str | Path, kind: str = "recipe") -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: of the file.
        kind: what it should be, for the message.

    Raises:
        ParameterError: it cannot be read.
    """
    text = read_text(path)
    # tomllib's time grows with the square of a key's parts: 200,000 of them took minutes.
    if any(key.count(".") > _PARTS for key in re.split(r"[\n,=]", _TEXT.sub("", text))):
        raise ParameterError(f"`{path}` cannot be read as a {kind}: a key has more than {_PARTS} parts. Shorten it.")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError also: a number of over 4,300 digits
        raise ParameterError(f"`{path}` cannot be read as a {kind}: {reason(error)}.") from error


def parse_value(text: str) -> Any:  # noqa: ANN401
    """Parse a TOML value. Text that is not TOML is returned as it is, so that paths need no quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def to_dataclass(cls: type[T], name: str, table: dict[str, Any]) -> T:
    """Build a dataclass from a TOML table.

    Args:
        cls: every field has a default; a value in the table must have the type of the default.
        name: of the table, for error messages.
        table: values by field name.

    Raises:
        UnknownNameError: the dataclass has no such field.
        ParameterError: a value has another type than its default, or is outside its range or above `MAX_NUMBER`.
    """
    table = current_names(cls, name, table)
    defaults = {f.name: f.default for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key, value in table.items():
        if key not in defaults:
            raise UnknownNameError(f"key of [{name}]", key, defaults)
        if not _same_type(as_tuple(value), defaults[key]):
            wanted, example = type_in_words(get_type_hints(cls)[key]), json.dumps(defaults[key])
            raise ParameterError(f"`{key}` of [{name}] ({shown(value)}) must be {wanted}; the default is {example}.")
    with named_table(name):
        for key, value in table.items():
            check_numbers(value, key)  # whole numbers first: a float cannot hold one of 400 digits
            check_numbers(_as_float(as_tuple(value), defaults[key]), key)
        return cls(**{key: _as_float(as_tuple(value), defaults[key]) for key, value in table.items()})


@contextmanager
def named_table(name: str) -> Iterator[None]:
    """Begin the error of a value with the table that holds it."""
    try:
        yield
    except MwdnError as error:
        error.args = (f"[{name}]: {error}",)
        raise


def check_table(value: Any, name: str) -> dict[str, Any]:  # noqa: ANN401
    """Return the value called ``name``, or raise a `ParameterError` if it is not a table."""
    if not isinstance(value, dict):
        raise ParameterError(f"`{name}` ({shown(value)}) must be a table: [{name}].")
    return value


def check_numbers(value: Any, name: str) -> None:  # noqa: ANN401
    """Check the number called ``name``, or each number of a list; other values pass."""
    if isinstance(value, list | tuple):
        for each in value:
            check_numbers(each, name)
    elif isinstance(value, int) and not abs(value) < 2**63:
        raise ParameterError(f"`{name}` ({shown(value)}) must have 63 bits at most.")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ParameterError(f"`{name}` ({value}) must be finite.")
    elif isinstance(value, float) and not abs(value) <= MAX_NUMBER:
        raise ParameterError(f"`{name}` ({value:g}) must be {MAX_NUMBER:g} at most.")


def current_names(kind: type, name: str, table: dict[str, Any], *, warn: bool = True) -> dict[str, Any]:
    """The table with renamed keys under their new names.

    Args:
        kind: dataclass of the table; its class variable ``RENAMED``, if any, maps former names to new ones.
        name: of the table, for messages.
        table: values by name.
        warn: emit a warning for each former name.

    Raises:
        ParameterError: a key is given by both names.
    """
    renamed: dict[str, str] = getattr(kind, "RENAMED", {})
    for old in renamed.keys() & table.keys():
        new = renamed[old]
        if new in table:
            raise ParameterError(f"`{old}` and `{new}` of [{name}] are one key. Leave `{old}` out.")
        if warn:
            warnings.warn(f"`{old}` of [{name}] is now called `{new}`. Rename it.", FutureWarning, stacklevel=2)
    return {renamed.get(key, key): value for key, value in table.items()}


def as_tuple(value: Any) -> Any:  # noqa: ANN401
    """Tuples for the lists of TOML and JSON, nested ones too; other values as they are."""
    return tuple(map(as_tuple, value)) if isinstance(value, list) else value


def _same_type(value: object, default: object) -> bool:
    if isinstance(value, tuple) and isinstance(default, tuple):
        # An empty default stands for any number of strings.
        return all(map(_same_type, value, default or ("",) * len(value))) and len(value) == len(default or value)
    return type(value) is type(default) or (type(value) is int and type(default) is float)


def _as_float(value: Any, default: object) -> Any:  # noqa: ANN401
    """Convert an integer to a float where the default is a float."""
    if isinstance(value, tuple) and isinstance(default, tuple):
        return tuple(map(_as_float, value, default or value))
    return float(value) if isinstance(default, float) else value
