"""Iterations that report their progress: the fraction of a solver's work that is done."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

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
