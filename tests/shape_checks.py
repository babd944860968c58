"""Checks the shapes and types of the first calls of each function in a test, and leaves out those after them.

A solver calls the same ten functions in each of its iterations, with the same shapes. To check all of these calls takes
as long as the iterations. Functions are prepared for the check when they are called first, which saves half of the time
of the imports.
"""

import functools
import inspect
from collections.abc import Callable
from types import CodeType
from typing import Any

import jaxtyping

CHECKED = 10
"""Calls of each function that are checked in a test."""

CHECKED_INNER = 2
"""The same for functions inside functions. Each of them is prepared anew, which takes milliseconds."""

_calls: dict[CodeType, int] = {}
_jaxtyped = jaxtyping.jaxtyped


def start_again() -> None:
    """The next calls are checked, as at the beginning."""
    _calls.clear()


def first_calls(function: Any = None, *, typechecker: Callable[..., Any]) -> Any:
    """As `jaxtyping.jaxtyped`, for the first calls of a function."""
    if function is None:
        return functools.partial(first_calls, typechecker=typechecker)
    if not inspect.isfunction(function):  # a dataclass; one whose construction is wrapped by `checked` stays as it is
        wrapped = getattr(function.__init__, "__globals__", {}).get("__name__") == __name__
        return function if wrapped else _jaxtyped(function, typechecker=typechecker)
    code, checked = function.__code__, []
    limit = CHECKED_INNER if "<locals>" in function.__qualname__ else CHECKED

    @functools.wraps(function)
    def call(*arguments, **options):
        done = _calls.get(code, 0)
        if done >= limit or jaxtyping.config.jaxtyping_disable:
            return function(*arguments, **options)
        _calls[code] = done + 1
        if not checked:
            checked.append(_jaxtyped(function, typechecker=typechecker))
        return checked[0](*arguments, **options)

    return call


def install(package: str) -> None:
    """Check each function and dataclass of a package that is imported after this call."""
    jaxtyping.jaxtyped = first_calls
    jaxtyping.install_import_hook(package, "beartype.beartype")
