"""Freed memory of the CPU: kept for the next array, or handed back and forth."""

import ctypes
import sys

_MALLOPT = {"M_TRIM_THRESHOLD": (-1, -1), "M_MMAP_MAX": (-4, 0), "M_ARENA_MAX": (-8, 1)}
"""Options of glibc's malloc.h, and what they are set to: no memory goes back, all comes from one heap."""


def keep_memory() -> bool:
    """Let this process keep the memory that it frees, and use it for its next arrays; for all libraries in it.

    Otherwise glibc asks Linux for every large array anew, and Linux fills it with zeros, page by page: of a picture of
    1080 x 1920 that takes longer than all arithmetic. The price: the process stays as large as it ever was. The command
    line does this.

    Returns:
        Whether it does from now on; only glibc, on Linux, can be asked.
    """
    if sys.platform != "linux":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and all(mallopt(*setting) == 1 for setting in _MALLOPT.values())
