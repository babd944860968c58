"""The number of torch's threads for the operations of one calling thread."""

import os
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import torch

_LOCK = Lock()
"""Two threads at once would read each other's number as that of new threads."""


def usable_processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use_threads(count: int) -> None:
    """Let torch use ``count`` threads for operations of the calling thread; other threads keep their number.

    `torch.set_num_threads` changes the number of the calling thread, and the default of new threads. A temporary thread
    reads this default before, and another one restores it.
    """
    with _LOCK:
        with ThreadPoolExecutor(1) as fresh:
            before = fresh.submit(torch.get_num_threads).result()
        torch.get_num_threads()  # else this thread's first operation would take the default of new threads
        torch.set_num_threads(count)
        with ThreadPoolExecutor(1) as fresh:
            fresh.submit(torch.set_num_threads, before).result()
