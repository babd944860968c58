"""The number of threads on which torch computes what one thread asks for."""

import os
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import torch

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
