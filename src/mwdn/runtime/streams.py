"""Overlap work in threads: prefetching, and the newest frame of a live source."""

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
    """Apply ``work`` to items in a thread, in order, a few items ahead of the consumer.

    Stages can be chained: work in the caller's thread between two of them overlaps with both. At the end of the
    ``with`` block, also on an error, the thread stops after its current item.

    Args:
        work: called in the thread.
        items: iterated in the caller's thread, so an item may be a result computed there.
        depth: largest number of items that wait or are in progress, besides the one being consumed.

    Yields:
        An iterator over the results, in order. An error of ``work`` is raised in place of its result.
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
    """Yield the newest frame of a source each time, and drop the frames in between.

    The source is iterated in a thread, at its own pace, and only its newest frame is kept. Close the generator before
    its source: ``with camera, contextlib.closing(latest(camera)) as frames``.

    Args:
        frames: a camera, or any endless iterable of frames. If it ends, its last frame is still yielded.

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
                del frame  # else it would stay alive until the next one
                if closed:
                    break
        except BaseException as problem:
            error = problem
        with changed:
            ended.append(error)
            changed.notify()

    source = Thread(target=run, daemon=True)  # a source that hangs must not keep the process alive
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
