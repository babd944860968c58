"""A wrong call in one sentence: which option or argument, what was given, what is allowed."""

import difflib
from collections.abc import Iterable
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from cyclopts import CoercionError, CycloptsError, MissingArgumentError, UnknownOptionError
from cyclopts.argument import Argument
from cyclopts.exceptions import RepeatArgumentError, UnknownCommandError, UnusedCliTokensError
from cyclopts.token import Token

from mwdn.errors import ParameterError, UnknownNameError

_WORDS = {int: "whole number", float: "number", bool: "true or false", str: "text", Path: "path", NoneType: "none"}
_NUMBERS = {2: "two", 3: "three"}


def wrong_call(error: CycloptsError, commands: Iterable[str]) -> ParameterError:
    """An error of the command line's parser as one of ours.

    Args:
        error: of the parser.
        commands: all that there are.
    """
    match error:
        case UnknownCommandError(unused_tokens=[name, *_]):
            return UnknownNameError("command", name, commands)  # `--foo` without a command, too
        case UnknownOptionError():
            return ParameterError(_unknown_option(error))
        case CoercionError(argument=Argument() as argument, token=token, msg=None):
            return ParameterError(_wrong_value(argument, token))
        case MissingArgumentError(argument=Argument() as argument):
            return ParameterError(_missing(error, argument))
        case RepeatArgumentError():
            return ParameterError(f"`{error.token.keyword}` is given more than once.")
        case UnusedCliTokensError(unused_tokens=list() as rest):
            return ParameterError(f"Too many arguments: {' '.join(rest)}. {_see_help(error)}")
    return ParameterError(str(error))


def _wrong_value(argument: Argument, token: Token | None) -> str:
    name, given = _name(argument), ""
    if token is not None:
        _, takes_any_number = argument.token_count()
        values = [token] if takes_any_number else argument.tokens
        given = f" ({' '.join(each.value for each in values)})"
        if token.source in ("", "cli"):
            name = token.keyword or name
        else:  # a file, where a table is its keyword
            given += f" in `{token.source}`"
    return f"`{name}`{given} must be {in_words(argument.hint)}."


def _unknown_option(error: UnknownOptionError) -> str:
    name = (error.token.keyword or error.token.value).partition("=")[0]
    shown = [each for each in error.argument_collection if each.parse and each.show]
    known = [option for each in shown for option in each.names if option.startswith("--")]
    nearest = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {nearest[0]}?" if nearest else ""
    listed = ", ".join(option for option in known if not option.startswith("--no-")) or "none"
    return f"Unknown option: {name}.{hint} Options: {listed}. {_see_help(error)}"


def _missing(error: MissingArgumentError, argument: Argument) -> str:
    name = error.keyword or next((token.keyword for token in argument.tokens if token.keyword), None)
    if name is not None:
        return f"`{name}` must be followed by {in_words(argument.hint)}."
    return f"`{_name(argument)}` is missing. {_see_help(error)}"


def _see_help(error: CycloptsError) -> str:
    return f"See `{' '.join(['mwdn', *(error.command_chain or ())])} --help`."


def _name(argument: Argument) -> str:
    """An option, or an argument in capitals as in the command's help."""
    return argument.name if argument.field_info.is_keyword_only else argument.name.lstrip("-").upper()


def in_words(kind: Any) -> str:  # noqa: ANN401
    """What an annotated type allows on the command line: "srgb or a number", "two whole numbers"."""
    return _either(dict.fromkeys(_alternatives(kind)))


def _alternatives(kind: Any) -> list[str]:  # noqa: ANN401
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return list(map(str, parts))
    if origin is tuple and ... not in parts:
        return [f"{_NUMBERS[len(parts)]} {_WORDS[parts[0]]}s"]
    if origin in (tuple, list):
        return _alternatives(parts[0])
    if parts:
        if Path in parts:  # cyclopts takes any text for a path
            return _alternatives(Path)
        return [words for part in parts for words in _alternatives(part)]
    return [_WORDS[kind] if kind in (bool, NoneType, str) else f"a {_WORDS[kind]}"]


def _either(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last
