"""Ctrl-C, SIGTERM, a closed pipe and a full disk end a command with one line, or none: no traceback.

Imported before all else, so that this holds while the other modules are imported, which takes seconds.
"""

import errno
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TypeGuard

GO_ON = {
    "reconstruct": "Finished pictures are kept. The same command with --resume goes on.",
    "train": "What is saved is kept. The same command resumes.",
    "capture": "All pairs so far are kept. The same command continues.",
    "preview": "Stored cameras and recordings are kept.",
    "benchmark": "Finished networks and scores are kept. The same command resumes.",
}
"""What to say where a command does not say more."""

OTHERWISE = "Unfinished files are not kept. The same command starts again."


class _Interrupt(KeyboardInterrupt):
    """Ctrl-C. After a `KeyboardInterrupt` itself in code that `exec` runs, as dataclasses do, Python ends by SIGINT."""


@contextmanager
def ended_by_signals(arguments: Sequence[str]) -> Iterator[Sequence[int]]:
    """Exit with 130 (128 + SIGINT), 143 (SIGTERM) or 141 (SIGPIPE), as shells report it, if one of them ends the work.

    Exit with 2 if standard output is a file on a full disk.

    SIGTERM is turned into Ctrl-C, so the work is ended in the same way: training saves its state after the step in
    progress. Under torchrun, which waits for its processes, SIGTERM ends a process at once.

    Args:
        arguments: of the command line.

    Yields:
        Numbers of the signals received so far.
    """
    received: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise _Interrupt

    def terminate(number: int, frame: FrameType | None) -> None:
        received.append(number)
        signal.raise_signal(signal.SIGINT)

    handlers = {signal.SIGINT: interrupt} | ({} if "RANK" in os.environ else {signal.SIGTERM: terminate})
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield received
    except SystemExit:
        raise
    except BrokenPipeError:
        _discard_output()
        sys.exit(141)  # Windows has no SIGPIPE
    except BaseException as error:
        if not (received or isinstance(error, KeyboardInterrupt)):
            if "--debug" in arguments or not is_full(error):
                raise
            with suppress(OSError):  # standard error may be on the same disk
                print(f"Error: The output cannot be written: {error.strerror}. Make room.", file=sys.stderr)
            _discard_output()
            sys.exit(2)
        if os.environ.get("RANK", "0") == "0":  # one of several processes speaks
            said = str(error) if isinstance(error, KeyboardInterrupt) else ""
            print(said or f"Interrupted. {how_to_go_on(arguments)}".rstrip(), file=sys.stderr)
        sys.exit(128 + (signal.SIGTERM if signal.SIGTERM in received else signal.SIGINT))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def is_full(error: BaseException) -> TypeGuard[OSError]:
    """Whether there is no room for standard output. Errors of other files have their names."""
    full = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return isinstance(error, OSError) and error.errno in full and error.filename is None


def _discard_output() -> None:
    """Discard what is left in standard output and standard error: at its end, Python would try again to write it."""
    for stream in (sys.stdout, sys.stderr):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def how_to_go_on(arguments: Sequence[str]) -> str:
    """Sentence about what an interrupted command keeps, and how to go on; empty if only help was asked for."""
    command = next((word for word in arguments if not word.startswith("-")), None)
    if command is None or not {"--help", "-h"}.isdisjoint(arguments):
        return ""
    return GO_ON.get(command, OTHERWISE)
