"""Messages of the library in the words of the command line: `psf_bin` is `--psf-bin`."""

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
        The message, where a word in backticks is an option if the command has it or if it was typed. If the message
        starts with the table of a recipe, ``[sensor]: ``, its words are keys of this table, and the command's own
        options of the same name are not meant.
    """
    table = re.match(r"\[([^]]+)\]: ", message)
    keys = {option.split("=")[0] for option in typed if option.startswith("--")} - set(own)

    def flag(match: re.Match[str]) -> str:
        if match[1] in typed:
            return match[0]
        key = match[1].replace("_", "-")
        if table:
            known = {f"--{table[1]}.{key}", f"--{key}"} & keys
        else:
            known = {f"--{key}"} & {*own, *keys} or {option for option in keys if option.endswith(f".{key}")}
        return f"`{min(known)}`" if known else match[0]

    return re.sub(r"`([a-z]\w*)`(?! of \[)", flag, message)
