"""Ctrl-C between two steps instead of within one."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def kept_interrupt() -> Iterator[None]:
    """Keep the handler of Ctrl-C (SIGINT), though a library within may set its own.

    Outside the main thread, which alone receives signals, nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Only record the first Ctrl-C (SIGINT), so that the work in progress is completed; the second one interrupts.

    Outside the main thread nothing is changed.

    Yields:
        Whether Ctrl-C has been pressed.
    """
    pressed, before = threading.Event(), signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        pressed.set()
        signal.signal(signal.SIGINT, before)

    with kept_interrupt():
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, note)
        yield pressed.is_set
