"""Messages of the library in the words of the command line: `psf_bin` is `--psf-bin`, `bin=4` is `--bin 4`."""

import ast
import re
from collections.abc import Collection


def as_typed(message: str, own: Collection[str], typed: Collection[str] = ()) -> str:
    """A message with the options of the running command as the user types them.

    Args:
        message: of an error; it names arguments and keys in backticks.
        own: options of the command, such as ``--psf-bin``.
        typed: words of the command line. Its ``--key`` and ``--table.key`` may change a recipe or a method; its other
            words are values, such as the name of a folder, and stay.

    Returns:
        The message with options in place of names. A word in backticks becomes an option if the command has it or if it
        was typed; so do keyword arguments such as ``bin=4, crop=(8, 8)``. In a message that starts with the table of a
        recipe, ``[sensor]: ``, words are keys of this table.
    """
    table = re.match(r"\[([^]]+)\]: ", message)
    keys = {option.split("=")[0] for option in typed if option.startswith("--")} - set(own)

    def option(name: str) -> str | None:
        key = name.replace("_", "-")
        if table:
            known = {f"--{table[1]}.{key}", f"--{key}"} & keys
        else:
            known = {f"--{key}"} & {*own, *keys} or {option for option in keys if option.endswith(f".{key}")}
        return min(known, default=None)

    def word(match: re.Match[str]) -> str:
        flag = None if match[1] in typed else option(match[1])
        return f"`{flag}`" if flag else match[0]

    def assignments(match: re.Match[str]) -> str:
        flags = [_typed(option(name), value) for name, value in _keyword_arguments(match[1])]
        return f"`{' '.join(flags)}`" if flags and all(flags) else match[0]

    message = re.sub(r"`([a-z]\w*)`(?! of \[)", word, message)
    return re.sub(r"`([a-z]\w*=[^`]*)`(?! of \[)", assignments, message)


def _keyword_arguments(text: str) -> list[tuple[str, object]]:
    """Names and values of ``bin=4, crop=(8, 8)``; empty for any other text."""
    try:
        call = ast.parse(f"f({text})", mode="eval").body
        return [(each.arg or "", ast.literal_eval(each.value)) for each in getattr(call, "keywords", ())]
    except (SyntaxError, ValueError):
        return []


def _typed(option: str | None, value: object) -> str:
    """An option with its value; a switch without; empty without option."""
    if option is None or value is True:
        return option or ""
    return " ".join([option, *map(str, value if isinstance(value, tuple) else (value,))])
