"""Options of solvers and networks, converted from the command line."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from cyclopts import App, Parameter

from mwdn.arguments import type_in_words
from mwdn.cli.wrong_calls import long_options, unknown_option
from mwdn.errors import ParameterError
from mwdn.inference.method_options import Option, list_options
from mwdn.solvers import SOLVERS

MethodOptions = Annotated[Any, Parameter(converter=lambda _, tokens: tokens, show=False)]
"""Type of a command's ``**options``: the tokens of each ``--name value`` that the command itself does not have."""


def read_options(
    methods: Sequence[str], tokens: Mapping[str, Any], command: Callable[..., object]
) -> dict[str, dict[str, Any]]:
    """Convert the options of methods from the command line.

    Args:
        methods: as given by the user. Each option goes to all methods that have it.
        tokens: of `MethodOptions`.
        command: the command, whose own options are suggested for a mistyped one.

    Returns:
        The options of each method.

    Raises:
        ParameterError: none of the methods has such an option, or the value does not fit its type.
    """
    known = {
        method: {option.name: option for option in (list_options(SOLVERS[method]) if method in SOLVERS else [])}
        for method in methods
    }
    values: dict[str, dict[str, Any]] = {method: {} for method in methods}
    for key, given in tokens.items():
        name = key.replace("-", "_")
        owners = [method for method in methods if name in known[method]]
        if not owners:
            raise ParameterError(_unknown(name, known, command))
        for method in owners:
            values[method][name] = _convert(known[method][name], given)
    return values


def _unknown(name: str, known: Mapping[str, Iterable[str]], command: Callable[..., object]) -> str:
    app = App()
    app.default(command)
    options = [_flag(option) for option in dict.fromkeys(chain.from_iterable(known.values()))]
    methods = f"{'method' if len(known) == 1 else 'methods'} {', '.join(map(repr, known))}"
    listed = ", ".join(options) or f"none; solvers ({', '.join(SOLVERS)}) have some"
    sentence = unknown_option(_flag(name), [*options, *long_options(app.assemble_argument_collection())])
    return f"{sentence} Options of the {methods}: {listed}. See `mwdn methods`."


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _convert(option: Option, given: Any) -> Any:  # noqa: ANN401
    """Value of an option: a number, a word of a `Literal`, or a NamedTuple with ``--name.field value`` for fields."""
    if isinstance(given, Mapping):
        parts = getattr(option.type, "__annotations__", {})
        nested = {key: Option(f"{option.name}.{key}", parts.get(key), None, "") for key in given}
        if given.keys() <= parts.keys():
            return option.default._replace(**{key: _convert(nested[key], tokens) for key, tokens in given.items()})
        known = ", ".join(parts) or "none"
        raise ParameterError(f"`{_flag(option.name)}` has the parts {known}, not {', '.join(given)}.")
    text = given[-1].value
    try:
        return _parse(option.type, text)
    except ValueError:
        like = ": `1,2,3`" if get_origin(option.type) is tuple else ""
        raise ParameterError(f"`{_flag(option.name)}` ({text}) must be {type_in_words(option.type)}{like}.") from None


def _parse(kind: Any, text: str) -> Any:  # noqa: ANN401
    """A value of a type; raises a `ValueError` if the text is none."""
    if get_origin(kind) is tuple:
        parts, kinds = text.strip("[]() ").split(","), get_args(kind)
        kinds = kinds[:1] * len(parts) if kinds[-1] is Ellipsis else kinds
        return tuple(_parse(each, part.strip()) for each, part in zip(kinds, parts, strict=True))
    if get_origin(kind) in (Union, UnionType):
        for each in sorted(get_args(kind), key=lambda each: each is not NoneType):  # `none` is no path
            with suppress(ValueError):
                return _parse(each, text)
    elif (get_origin(kind) is Literal and text in get_args(kind)) or kind in (str, Any):
        return text
    elif kind is NoneType and text == "none":
        return None
    elif kind in (int, float, Path):
        return kind(text)
    elif kind is bool and text in ("true", "false"):
        return text == "true"
    raise ValueError(text)
