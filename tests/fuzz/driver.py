"""Driver of the fuzz tests: seeded damage, and the judgement of what a reader makes of it.

A reader takes a file or refuses it by an `MwdnError` of one line. Memory and processor time are limited meanwhile.
"""

import os
import resource
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mwdn.errors import MwdnError

LONGEST = 300
"""Characters of a message, without the file's path."""

MEMORY = 2**30
"""Bytes that a reader may allocate to refuse a file."""

PROCESSOR_S = 20
"""Processor time after which a case counts as hanging; four times what a user is promised, for slow machines."""

DURATION_S = float(os.environ.get("MWDN_FUZZ_SECONDS", "600")) / 4
"""Duration of each of the four long runs of `make acceptance`: pictures, pairs, checkpoints and recipes."""


def damaged(data: bytes, random: np.random.Generator) -> bytes:
    """One to four damages: bits or bytes changed, zeros, a piece moved or doubled, the end cut off."""
    content = bytearray(data)
    for _ in range(random.integers(1, 5)):
        if len(content) < 8:
            break
        # Every third damage hits the header, where most numbers mean something.
        end = min(len(content), 200) if random.random() < 0.33 else len(content)
        at = int(random.integers(0, end))
        piece = content[at : at + int(random.integers(1, 65))]
        match random.choice(["bit", "byte", "zeros", "move", "double", "end"], p=[0.35, 0.25, 0.1, 0.1, 0.1, 0.1]):
            case "bit":
                content[at] ^= 1 << int(random.integers(0, 8))
            case "byte":
                content[at] = int(random.choice([0, 1, 127, 128, 255, random.integers(0, 256)]))
            case "zeros":
                content[at : at + len(piece)] = bytes(len(piece))
            case "move":
                del content[at : at + len(piece)]
                to = int(random.integers(0, len(content) + 1))
                content[to:to] = piece
            case "double":
                content[at:at] = piece
            case "end":
                del content[at:]
    return bytes(content)


class TimeIsUpError(BaseException):
    """A case used up its processor time; not an `Exception`, so that no reader catches it."""


@contextmanager
def limits() -> Iterator[None]:
    """Limit the address space to `MEMORY` more than now, and the processor time. Only in the main thread."""

    def stop(*_: object) -> None:
        raise TimeIsUpError

    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, stop)
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, hard))
    signal.setitimer(signal.ITIMER_PROF, PROCESSOR_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGPROF, handler)


def outcome(read: Callable[[], object], path: Path, *, named: bool = True) -> str:
    """``taken``, ``refused``, or ``wrong: ...``.

    Args:
        read: reads the file.
        path: of the file.
        named: whether the message of a refusal must name the file.
    """
    try:
        with limits():
            read()
    except MwdnError as error:
        text = str(error).replace(str(path), "")
        fine = len(text) <= LONGEST and text.isprintable() and (not named or str(path) in str(error))
        return "refused" if fine else f"wrong: message of {len(text):,} characters: {str(error)[:400]!r}"
    except TimeIsUpError:
        return f"wrong: more than {PROCESSOR_S} s"
    except Exception as error:
        return f"wrong: {type(error).__name__}: {str(error)[:200]!r}"
    return "taken"


def sweep(
    contents: Iterable[bytes],
    read: Callable[[Path], object],
    path: Path,
    *,
    duration_s: float = float("inf"),
    named: bool = True,
) -> Counter[str]:
    """Count the outcomes of many contents of one file; a wrong one has the number of its first case.

    Args:
        contents: of the file, in turn.
        read: reads it.
        path: where to write it.
        duration_s: stop after this time.
        named: as for `outcome`.
    """
    outcomes: Counter[str] = Counter()
    first: dict[str, int] = {}
    end = time.monotonic() + duration_s
    for number, content in enumerate(contents):
        path.write_bytes(content)
        result = outcome(lambda: read(path), path, named=named)
        case = first.setdefault(result, number)
        outcomes[f"{result} (case {case})" if result.startswith("wrong") else result] += 1
        if time.monotonic() > end:
            break
    return outcomes


def failures(outcomes: Counter[str]) -> list[str]:
    """Outcomes that must not happen."""
    return [result for result in outcomes if result.startswith("wrong")]
