"""A wrong call in one sentence: which option or argument, what was given, what is allowed."""

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from cyclopts import CoercionError, CycloptsError, MissingArgumentError, UnknownOptionError
from cyclopts.argument import Argument
from cyclopts.exceptions import ArgumentOrderError, RepeatArgumentError, UnknownCommandError, UnusedCliTokensError
from cyclopts.token import Token

from mwdn.arguments import type_in_words
from mwdn.errors import ParameterError, UnknownNameError


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
        case ArgumentOrderError(token=given):
            return ParameterError(
                f"`{given}` must come before the options, in the order of the help. {_see_help(error)}"
            )
        case MissingArgumentError(argument=Argument() as argument):
            return ParameterError(_missing(error, argument))
        case RepeatArgumentError():
            return ParameterError(_repeated(error.token.keyword or "", error.root_input_tokens or ()))
        case UnusedCliTokensError(unused_tokens=list() as rest):
            return ParameterError(f"Too many arguments: {' '.join(rest)}. {_list_hint(rest)}{_see_help(error)}")
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
    return f"`{name}`{given} must be {type_in_words(_one_word(argument.hint))}."


def _repeated(option: str, given: Sequence[str]) -> str:
    switch = option.removeprefix("--no-").removeprefix("--")
    both = [f"--{switch}", f"--no-{switch}"]
    if all(each in given for each in both):
        return f"`{both[0]}` and `{both[1]}` exclude each other."
    return f"`{option}` is given more than once."


def _list_hint(rest: Sequence[str]) -> str:
    """A sentence for `--pictures.size 96 96`, whose second number is no argument."""
    numbers = all(re.fullmatch(r"-?\d+(\.\d+)?", each) for each in rest)
    return "A list of a recipe is one argument, in quotes: '[96, 96]'. " if numbers else ""


def _unknown_option(error: UnknownOptionError) -> str:
    name = (error.token.keyword or error.token.value).partition("=")[0]
    known = long_options(error.argument_collection)
    listed = [option for option in known if not option.startswith("--no-")]
    return f"{unknown_option(name, known)} Options: {', '.join(listed) or 'none'}. {_see_help(error)}"


def unknown_option(name: str, known: Sequence[str]) -> str:
    """One sentence, or two if one of the known options is like the unknown one."""
    nearest = difflib.get_close_matches(name, known, n=1)
    return f"Unknown option: {name}." + (f" Did you mean {nearest[0]}?" if nearest else "")


def long_options(arguments: Iterable[Argument]) -> list[str]:
    """All options that the help shows, in their long form."""
    shown = [each for each in arguments if each.parse and each.show]
    return [option for each in shown for option in each.names if option.startswith("--")]


def _missing(error: MissingArgumentError, argument: Argument) -> str:
    name = error.keyword or next((token.keyword for token in argument.tokens if token.keyword), None)
    if name == "-":
        return "Standard input is not read. Save it as a file, then name the file."
    if name is not None and get_origin(argument.hint) is dict:  # a key of a recipe
        return f"`{name}` must be followed by its value: `{name} VALUE`; a switch takes `true` or `false`."
    if name is not None:
        return f"`{name}` must be followed by {type_in_words(_one_word(argument.hint))}."
    return f"`{_name(argument)}` is missing. {_see_help(error)}"


def _see_help(error: CycloptsError) -> str:
    return f"See `{' '.join(['mwdn', *(error.command_chain or ())])} --help`."


def _name(argument: Argument) -> str:
    """An option, or an argument in capitals as in the command's help."""
    return argument.name if argument.field_info.is_keyword_only else argument.name.lstrip("-").upper()


def _one_word(kind: Any) -> Any:  # noqa: ANN401
    """The type of one word on the command line, where lists are words, and any word can be a path."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is list or (origin is tuple and ... in parts):
        return parts[0]
    if origin in (Union, UnionType):
        return Path if Path in parts else Union[tuple(map(_one_word, parts))]  # noqa: UP007
    return kind
