"""One benchmark, several processes: whoever is free takes the next part.

They need to know nothing of each other but the folder, which may be on a shared disk: started by torchrun, by a
cluster's scheduler or by hand, together or one after the other. A lock goes with the process that held it, so the
part of one that was killed goes on in another.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

from filelock import FileLock, Timeout

from mwdn.io.files import writable


def held(folder: Path, part: str) -> FileLock:
    """The lock of a part, which may be a path: a context in which no other process is at it.

    Raises:
        ParameterError: the folder cannot be written to.
    """
    path = folder / "locks" / f"{part}.lock"
    with writable(folder):
        path.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(path)


def shared(folder: Path, parts: Sequence[str]) -> Iterator[str]:
    """Each part in turn, held while the loop is at it: those of nobody first, then the others as they become free.

    So after the loop every part has been done; what was done elsewhere should be found done.
    """
    others = []
    for part in parts:
        try:
            own = held(folder, part).acquire(blocking=False)
        except Timeout:
            others.append(part)
            continue
        with own:
            yield part
    for part in others:
        with held(folder, part):
            yield part
