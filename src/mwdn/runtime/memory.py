"""Keep freed CPU memory in the process, for the next arrays."""

import ctypes
import sys

_MALLOPT = {"M_TRIM_THRESHOLD": (-1, -1), "M_MMAP_MAX": (-4, 0), "M_ARENA_MAX": (-8, 1)}
"""Options of glibc's malloc.h and their values: never return memory to the system, allocate all of it on one heap."""


def keep_memory() -> bool:
    """Make this process keep freed memory for its next arrays, in all libraries.

    By default glibc requests memory for every large array from Linux, which fills it with zeros page by page: for a
    picture of 1080 x 1920 this takes longer than the arithmetic. The price: the process never shrinks. The command line
    calls this function.

    Returns:
        Whether it succeeded; it needs glibc, on Linux.
    """
    if sys.platform != "linux":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and all(mallopt(*setting) == 1 for setting in _MALLOPT.values())
