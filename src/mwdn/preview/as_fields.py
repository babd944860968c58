"""Messages of the package in the words of the HTTP interface: `bin=4` and `--bin 4` are `calibration={"bin": 4}`."""

import json
import re
from typing import Any

from mwdn.preview.cameras import CAMERA_OPTIONS
from mwdn.preview.methods import RANGES


def as_fields(message: str) -> str:
    """A message with fields of a request in place of arguments of Python and options of the command line.

    Args:
        message: of an error; it names them in backticks.

    Returns:
        The message. What is no field, such as a frame that only files of the command line hold, stays as it is.
    """
    message = re.sub(r"`--([a-z-]+)`", lambda match: _field(match[1]) or match[0], message)
    message = re.sub(r"`--([a-z-]+ [^`]{,200})`", lambda match: _fields(_typed(match[1])) or match[0], message)
    message = re.sub(r"`([a-z]\w*=[^`]{,200})`", lambda match: _fields(_arguments(match[1])) or match[0], message)
    return re.sub(r"(?<= of )`(FrameFormat|PsfFormat)`", "`calibration`", message)


def _field(option: str) -> str:
    """An option of the command line that has no value there."""
    name = option.replace("-", "_")
    return f"`{name}`" if name in (*CAMERA_OPTIONS, *RANGES) else _fields({name: True})


def _fields(values: dict[str, Any]) -> str:
    if values and values.keys() <= set(CAMERA_OPTIONS):
        return f"`calibration={json.dumps(values)}`"
    if values and values.keys() <= RANGES.keys():
        return f"`options={json.dumps(values)}`"
    match values:
        case {"white_balance": list() as gains}:
            return f"`white_balance={','.join(map(str, gains))}`"
        case {"align": True}:
            return "`align=true`"
        case {"room_light": True}:
            return "`room_light=true`"
        case {"ambient": "FILE"}:
            return "`ambient=@FILE`"
    return ""


def _typed(line: str) -> dict[str, Any]:
    """Names and values of ``bin 4 --crop 8 8 --grey``."""
    options = {}
    for option in line.split(" --"):
        name, *words = option.split(" ")
        values = [_value(word) for word in words]
        options[name.replace("-", "_")] = True if not values else values[0] if len(values) == 1 else values
    return options


def _value(word: str) -> Any:  # noqa: ANN401
    try:
        return json.loads(word)
    except ValueError:
        return word


def _arguments(text: str) -> dict[str, Any]:
    """Names and values of ``bin=4, crop=(8, 8)``; empty for any other text, such as one of a client."""
    pairs = re.sub(r"([a-z]\w*)=", r'"\1": ', text).translate(str.maketrans("()'", '[]"')).replace("True", "true")
    try:
        return dict(json.loads(f"{{{pairs}}}"))
    except ValueError:
        return {}
