"""The number of threads on which torch computes what one thread asks for."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cache
from threading import Lock
from typing import TypeVar

import torch

A = TypeVar("A")
B = TypeVar("B")

_LOCK = Lock()
"""Two threads at once would take each other's number for that of new threads."""


def usable_processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use_threads(count: int) -> None:
    """Let torch compute on ``count`` threads what the calling thread asks for; other threads keep their number.

    `torch.set_num_threads` changes the calling thread, and the number with which new threads start. A thread of its own
    reads the second before, and another sets it back.
    """
    with _LOCK:
        with ThreadPoolExecutor(1) as fresh:
            before = fresh.submit(torch.get_num_threads).result()
        torch.get_num_threads()  # or else torch takes up the number of new threads at this thread's first operation
        torch.set_num_threads(count)
        with ThreadPoolExecutor(1) as fresh:
            fresh.submit(torch.set_num_threads, before).result()


def in_threads(function: Callable[[A], B], parts: Sequence[A]) -> list[B]:
    """Apply ``function`` to all parts at the same time, each on one thread of torch.

    For work of many small operations, which gain nothing from a second thread each. The first part has the caller's
    context (`mwdn.runtime.iterations`); gradients are not recorded.
    """
    inferring = torch.is_inference_mode_enabled()

    def run(part: A) -> B:
        with torch.inference_mode(inferring), torch.no_grad():
            return function(part)

    first, *others = parts
    work = [_pool().submit(copy_context().run, run, first), *(_pool().submit(run, part) for part in others)]
    return [each.result() for each in work]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_processors(), thread_name_prefix="mwdn", initializer=use_threads, initargs=(1,))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
