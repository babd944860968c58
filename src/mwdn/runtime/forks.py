"""Forked children compute on one thread.

A fork copies only the thread that calls it. GNU OpenMP's other threads are missing in the child, and the first
operation on several threads waits for them forever.
"""

import os
from functools import cache, partial

import torch


@cache
def survive_forks() -> None:
    """Set torch to one thread in every child that is forked from now on; children that are spawned keep all.

    `torch.set_num_threads` with more in such a child hangs as before.
    """
    if hasattr(os, "register_at_fork"):  # not on Windows
        os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))
