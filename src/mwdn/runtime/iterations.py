"""Iterations that report their progress: the fraction of a solver's work that is done."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import torch

S = TypeVar("S")

_recorder: ContextVar[Callable[..., Any] | None] = ContextVar("recorder", default=None)
_report: ContextVar[Callable[[float], None] | None] = ContextVar("report", default=None)


@contextmanager
def watch_iterations(report: Callable[[float], None]) -> Iterator[None]:
    """Call ``report`` with the fraction of the work that is done, after each of the `iterations` in this thread."""
    token = _report.set(report)
    try:
        yield
    finally:
        _report.reset(token)


def iterations(count: int, *, start: float = 0.0, end: float = 1.0) -> Iterator[int]:
    """``range(count)`` for `watch_iterations`.

    Args:
        count: number of iterations.
        start: fraction of the work that is done before.
        end: fraction of the work that is done after.
    """
    report = None if torch.compiler.is_compiling() else _report.get()  # an export reports no progress
    for number in range(count):
        yield number
        if report is not None:
            report(start + (end - start) * (number + 1) / count)


def repeat(updates: Sequence[Callable[[S], S]], state: S, count: int, *, start: float = 0.0, end: float = 1.0) -> S:
    """Apply ``updates`` in turn to a state, a tuple of tensors, ``count`` times.

    Args:
        updates: of an iteration; together they keep the shapes and types of the state.
        state: at the beginning.
        count: number of iterations.
        start: as for `iterations`.
        end: as for `iterations`.
    """
    recorder = _recorder.get()
    if recorder is not None and count > 1:
        return recorder(updates, state, count)
    for _ in iterations(count, start=start, end=end):
        for update in updates:
            state = update(state)
    return state


@contextmanager
def record_loops(recorder: Callable[..., Any]) -> Iterator[None]:
    """Call ``recorder(updates, state, count)`` for each `repeat` in this thread: an export traces the updates once."""
    token = _recorder.set(recorder)
    try:
        yield
    finally:
        _recorder.reset(token)
