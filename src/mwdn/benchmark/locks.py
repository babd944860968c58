"""File locks that let several processes work on one benchmark: a free process takes the next part.

The processes share nothing but the folder, which may be on a network disk: start them with torchrun, with a cluster's
scheduler or by hand, at once or one after the other. The operating system releases a lock when its process ends, so
another process continues the part of a killed one.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from mwdn.io.files import as_parameter_error


@contextmanager
def lock(folder: Path, part: str, *, wait: bool = True) -> Iterator[None]:
    """Lock of a part: only one process at a time works on the part.

    Args:
        folder: of the benchmark.
        part: name of the part; may be a relative path.
        wait: for another process that holds it.

    Raises:
        ParameterError: the folder cannot be written to.
        filelock.Timeout: another process holds it.
    """
    path = folder / "locks" / f"{part}.lock"
    held = FileLock(path, blocking=wait)
    while not held.is_locked:
        with as_parameter_error(folder):
            path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # a process that failed has removed its folders, which were empty
            held.acquire()
    try:
        yield
    finally:
        held.release()


def claim_parts(folder: Path, parts: Sequence[str]) -> Iterator[str]:
    """Iterate over all parts, holding the lock of the current one: free parts first, then those of other processes.

    The loop waits for the other processes' parts, so every part has been done when it ends. Its body should return
    quickly for a part that another process has finished.
    """
    busy = []
    for part in parts:
        with ExitStack() as stack:
            try:
                stack.enter_context(lock(folder, part, wait=False))
            except Timeout:
                busy.append(part)
                continue
            yield part
    for part in busy:
        with lock(folder, part):
            yield part
