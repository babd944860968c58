"""The number of threads on which torch computes what one thread asks for."""

import os
from threading import Thread

import torch


def usable_processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use_threads(count: int) -> None:
    """Let torch compute on ``count`` threads what the calling thread asks for; other threads keep their number.

    `torch.set_num_threads` changes the calling thread, and the number with which new threads start. The second is set
    back, by a thread that ends at once.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    restore = Thread(target=torch.set_num_threads, args=(before,))
    restore.start()
    restore.join()
