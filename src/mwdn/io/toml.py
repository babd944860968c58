"""Tables of TOML, from a file or a command line, and the dataclasses they fill."""

import dataclasses
import json
import tomllib
import warnings
from pathlib import Path
from typing import Any, TypeVar

from mwdn.errors import ParameterError, UnknownNameError

T = TypeVar("T")


def read_toml(path: str | Path) -> dict[str, Any]:
    """Content of a file.

    Raises:
        ParameterError: it cannot be read.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ParameterError(f"`{path}` cannot be read as a recipe: {error}") from error


def value_of(text: str) -> Any:  # noqa: ANN401
    """What a text would be in TOML; what is nothing there is the text itself, so that paths need no quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def fill(kind: type[T], name: str, table: dict[str, Any]) -> T:
    """Make a dataclass of a table of TOML.

    Args:
        kind: of which every field has a default, whose type the table's value must have.
        name: of the table, for messages.
        table: values by the fields' names.

    Raises:
        UnknownNameError: a key that the dataclass has not.
        ParameterError: a value of another kind than its default, or outside its range.
    """
    table = current_names(kind, name, table)
    known = {f.name: f.default for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for key, value in table.items():
        if key not in known:
            raise UnknownNameError(f"key of [{name}]", key, known)
        if not _alike(_listless(value), known[key]):
            example = json.dumps(known[key])
            raise ParameterError(f"`{key}` of [{name}] ({value!r}) must be of the same kind as its default, {example}.")
    return kind(**{key: _as_float(_listless(value), known[key]) for key, value in table.items()})


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


def _listless(value: Any) -> Any:  # noqa: ANN401
    return tuple(value) if isinstance(value, list) else value


def _alike(value: object, example: object) -> bool:
    if isinstance(value, tuple) and isinstance(example, tuple):
        # Where the default is empty, any number of texts.
        return all(map(_alike, value, example or ("",) * len(value))) and len(value) == len(example or value)
    return type(value) is type(example) or (type(value) is int and type(example) is float)


def _as_float(value: Any, example: object) -> Any:  # noqa: ANN401
    """TOML's 12 where 12.0 is meant."""
    if isinstance(value, tuple) and isinstance(example, tuple):
        return tuple(map(_as_float, value, example or value))
    return float(value) if isinstance(example, float) else value
