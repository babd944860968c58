"""Everything that this package raises on purpose.

```text
MwdnError
├── ShapeError (ValueError)        two arrays that do not fit together
├── ParameterError (ValueError)    a number or an option outside its range
│   └── UnknownNameError           a name that no method, network or recipe key has
├── ImageError (ValueError)        a picture or frame that cannot be read or written
│   ├── FrameShapeError            an array or file with other axes than a frame; also a ShapeError
│   └── FrameTypeError             with numbers of another type, or no array at all; also a TypeError
├── PsfError (ValueError)          a PSF that no reconstruction can trust
├── AlignmentError (ValueError)    a displayed picture that cannot be found in a reconstruction
├── CheckpointError (ValueError)   weights that are damaged or belong to something else
├── ExportError                    a method that cannot be exported, or gives other results after export
├── DivergenceError                a loss that is no longer finite
├── CameraError                    a camera that cannot be opened, or delivers no frames any more
├── DisplayError                   a display that does not show what it should
├── PluginError                    a plugin that raises an error of its own
├── MissingPackageError (ImportError)  an optional library that is not installed
└── ProcessError                   another process of a distributed run has ended
```
"""

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any, TypeVar

Error = TypeVar("Error", bound=BaseException)

LONGEST = 300
"""Characters of a message at most, besides those of paths."""


class MwdnError(Exception):
    """Base of the tree: catch this to catch them all. Its message is one line, which keeps its start and its end."""

    def __str__(self) -> str:
        text = one_line(super().__str__())
        most = LONGEST + sum(len(part) for part in text.split("`")[1::2] if len(part) < 1000 and {"/", "\\"} & {*part})
        return text if len(text) <= most else f"{text[: most * 2 // 3 - 5]} ... {text[-(most // 3) :]}"


class ShapeError(MwdnError, ValueError):
    """Two arrays that must fit together do not."""


class ParameterError(MwdnError, ValueError):
    """A number or an option is outside its range."""


class UnknownNameError(ParameterError):
    """An unknown ``name`` of a ``kind`` of thing, such as ``"network"``; the message offers the nearest known one."""

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        name, known = cut(str(name), 80), sorted(known)
        spelling = {word.lower(): word for word in known}
        nearest = difflib.get_close_matches(name.lower(), spelling, n=1)
        hint = f" Did you mean '{spelling[nearest[0]]}'?" if nearest else ""
        start = f"No {kind} named '{name}'.{hint} Known: "
        text = f"{start}{', '.join(known)}."
        super().__init__(text if len(text) <= LONGEST else text[: LONGEST - 3].rpartition(", ")[0] + ", ...")


class ImageError(MwdnError, ValueError):
    """A picture or a frame cannot be read or written; the message names the file."""


class FrameShapeError(ImageError, ShapeError):
    """An array or a file has other axes than one frame: (H, W) or (H, W, 1 or 3 channels)."""


class FrameTypeError(ImageError, TypeError):
    """An array or a file holds numbers of another type than a frame, or there is no array at all."""


class PsfError(MwdnError, ValueError):
    """A PSF is saturated, empty, not finite, or of the wrong size."""


class AlignmentError(MwdnError, ValueError):
    """A displayed picture cannot be found in a reconstruction, or not with certainty."""


class CheckpointError(MwdnError, ValueError):
    """Weights are damaged, or belong to another network or camera."""


class ExportError(MwdnError):
    """A method cannot be exported to another runtime, or gives another result there; no file was written."""


class DivergenceError(MwdnError):
    """The loss of a training run is no longer finite."""


class CameraError(MwdnError):
    """A camera is missing, busy, disconnected or silent, or delivers other frames than before."""


class DisplayError(MwdnError):
    """No display is connected, or it does not show what it should."""


class PluginError(MwdnError):
    """A plugin raises an error of its own; the message names the plugin."""


class MissingPackageError(MwdnError, ImportError):
    """A library of an extra is not installed, or cannot be imported; the message names the extra."""


class ProcessError(MwdnError):
    """Another process of a distributed run has ended or cannot be reached."""


def one_line(text: str) -> str:
    """Text with control characters and surrogates, which file names may hold, as escape sequences."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def reason(error: BaseException) -> str:
    """First line of another library's error, at most 120 characters; its type if it says nothing."""
    lines = str(error).strip().splitlines()
    return cut(one_line(lines[0]).rstrip("."), 120) if lines else type(error).__name__


def without_traceback(error: Error) -> Error:
    """The error to keep. Its traceback, and those of its causes, would keep all their local variables: pictures."""
    error.__cause__ = error.__context__ = None
    return error.with_traceback(None)


def cut(text: str, most: int) -> str:
    """Text of at most ``most`` characters; a longer one ends in three dots."""
    return text if len(text) <= most else text[: most - 4] + " ..."


def shown(value: Any) -> str:  # noqa: ANN401
    """A value in a message: an array or tensor by its type and axes, anything else by its first characters."""
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", "")
    return f"{type(value).__name__} {tuple(shape)}, {dtype}" if shape else reprlib.repr(value)
