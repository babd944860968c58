"""Work that does not wait for other work: items prepared ahead in a thread, and the newest frame of a source."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Condition, Thread
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")


@contextmanager
def prefetch(work: Callable[[A], B], items: Iterable[A], *, depth: int = 2) -> Iterator[Iterator[B]]:
    """Work on items in a thread of their own, in order, a few ahead of whoever takes the results.

    Stages are chained: one that computes in the caller's thread between two of these overlaps with both. Whatever
    ends the ``with`` block ends the thread after its present item.

    Args:
        work: called in the thread.
        items: taken in the caller's thread, so an item may be the result of work done there.
        depth: at most so many items wait or are worked on, beside the one that is being taken.

    Yields:
        The results in order. An error of ``work`` is raised where its result is taken.
    """
    pool = ThreadPoolExecutor(1)

    def results() -> Iterator[B]:
        waiting: deque[Future[B]] = deque()
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > depth:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    try:
        yield results()
    finally:
        pool.shutdown(cancel_futures=True)


def latest(frames: Iterable[A]) -> Generator[A, None, None]:
    """Take the newest frame of a source whenever one is asked for; those that came meanwhile are dropped.

    The source runs in a thread of its own, at its own pace, and one of its frames is kept. Close the generator before
    what it reads from: ``with camera, contextlib.closing(latest(camera)) as frames``.

    Args:
        frames: a camera, or whatever else gives frames without end; if it ends, its last frame is still given.

    Yields:
        Frames in order, each at most once. An error of the source is raised after its last frame.
    """
    newest: deque[A] = deque(maxlen=1)
    ended: list[BaseException | None] = []
    changed, closed = Condition(), False

    def run() -> None:
        error = None
        try:
            for frame in frames:
                with changed:
                    newest.append(frame)
                    changed.notify()
                del frame  # or it would live until the next one
                if closed:
                    break
        except BaseException as problem:
            error = problem
        with changed:
            ended.append(error)
            changed.notify()

    source = Thread(target=run, daemon=True)  # one that hangs must not keep the process alive
    source.start()
    try:
        while True:
            with changed:
                changed.wait_for(lambda: newest or ended)
                if not newest:
                    break
                frame = newest.popleft()
            yield frame
            del frame
        if ended[0] is not None:
            raise ended[0]
    finally:
        closed = True
        source.join(timeout=5)
