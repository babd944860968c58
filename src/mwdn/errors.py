"""Everything that this package raises on purpose.

::

    MwdnError
    ├── ShapeError (ValueError)        two arrays that do not fit together
    ├── ParameterError (ValueError)    a number or an option outside its range
    │   └── UnknownNameError           a name that no method, network or recipe key has
    ├── ImageError (ValueError)        a picture or frame that cannot be read or written
    ├── PsfError (ValueError)          a PSF that no reconstruction can trust
    ├── CheckpointError (ValueError)   weights that are damaged or belong to something else
    ├── ExportError                    a method that cannot be exported, or gives other results after export
    ├── DivergenceError                a loss that is no longer finite
    └── ProcessError                   another process of a distributed run has ended

A message states what must hold, what was got, and the way out.
"""

import difflib
from collections.abc import Callable, Iterable
from inspect import signature
from typing import Any


class MwdnError(Exception):
    """Base of the tree: catch this to catch them all."""


class ShapeError(MwdnError, ValueError):
    """Two arrays that must fit together do not."""


class ParameterError(MwdnError, ValueError):
    """A number or an option is outside its range."""


class UnknownNameError(ParameterError):
    """An unknown name; the message offers the nearest known one.

    Args:
        kind: of the thing looked up, for example ``"network"``.
        name: the unknown name.
        known: every known name.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        known = sorted(known)
        spelling = {word.lower(): word for word in known}
        nearest = difflib.get_close_matches(name.lower(), spelling, n=1)
        hint = f" Did you mean '{spelling[nearest[0]]}'?" if nearest else ""
        super().__init__(f"No {kind} named '{name}'.{hint} Known: {', '.join(known)}.")


def check_options(of: Callable[..., Any], what: str, options: Iterable[str]) -> None:
    """Check that a function or class takes these keyword arguments.

    Args:
        of: the function or class.
        what: its name in the message, for example ``"network 'mwdn'"``.
        options: names of the keyword arguments.

    Raises:
        UnknownNameError: it does not take one of them.
    """
    known = signature(of).parameters
    for option in options:
        if option not in known:
            raise UnknownNameError(f"option of {what}", option, known)


def check_batch(image: Any, name: str) -> None:  # noqa: ANN401
    """Raise a `ShapeError` unless the image called ``name`` has the axes (B, C, H, W)."""
    if image.ndim != 4:
        raise ShapeError(f"`{name}` {tuple(image.shape)} must be (B, C, H, W). For one picture: `{name}[None]`.")


class ImageError(MwdnError, ValueError):
    """A picture or a frame cannot be read or written; the message names the file."""


class PsfError(MwdnError, ValueError):
    """A PSF is saturated, empty, not finite, or of the wrong size."""


class CheckpointError(MwdnError, ValueError):
    """Weights are damaged, or belong to another network or camera."""


class ExportError(MwdnError):
    """A method cannot be exported to another runtime, or gives another result there; no file was written."""


class DivergenceError(MwdnError):
    """The loss of a training run is no longer finite."""


class ProcessError(MwdnError):
    """Another process of a distributed run has ended or cannot be reached."""
