"""Overlap work in threads: prefetching, the newest frame of a live source, and its newest result."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Condition, Lock, Thread
from typing import Generic, TypeVar

from mwdn.runtime.threads import use_threads

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


def latest_results(
    begin: Callable[[A], Callable[[], B]], frames: Iterable[A], *, workers: int, threads: int = 1
) -> Generator[B, None, None]:
    """Process the newest frames of a source, several at the same time, and yield the newest result each time.

    A result is dropped if that of a later frame is already there. Close the generator before the source of the frames,
    as for `latest`.

    Args:
        begin: called with a frame, in the order of the frames, one at a time; the function that it returns is called at
            the same time as those of other frames.
        frames: as for `latest`.
        workers: frames in progress at the same time.
        threads: on which torch computes each of them.

    Yields:
        Results in the order of their frames. An error of the source, of ``begin`` or of its function is raised after
        the results of frames in progress.
    """
    team = _Team(begin, latest(frames), workers, threads)
    try:
        yield from team.results()
    finally:
        team.close()


class _Team(Generic[A, B]):
    """The threads of `latest_results`. One waits for a frame while the others work."""

    def __init__(
        self, begin: Callable[[A], Callable[[], B]], frames: Generator[A, None, None], workers: int, threads: int
    ) -> None:
        self.begin, self.frames, self.threads = begin, frames, threads
        self.turn, self.changed = Lock(), Condition()
        self.newest: deque[tuple[int, B]] = deque(maxlen=1)
        self.ended: list[BaseException | None] = []
        self.taken, self.done, self.closed = 0, 0, False
        self.workers = [Thread(target=self.run, daemon=True) for _ in range(workers)]
        for worker in self.workers:
            worker.start()

    def run(self) -> None:
        """Work until the frames end, or a worker fails."""
        error = None
        try:
            use_threads(self.threads)
            while not (self.closed or self.ended):
                self.process_one()
        except StopIteration:
            pass
        except BaseException as problem:
            error = problem
        with self.changed:
            self.ended.append(error)
            self.changed.notify()

    def process_one(self) -> None:
        """The next frame. Raises `StopIteration` after the last."""
        with self.turn:
            if self.closed:
                return
            finish = self.begin(next(self.frames))
            self.taken += 1
            number = self.taken
        try:
            result = finish()
            del finish  # and the frame: the condition may take a while
            with self.changed:
                if not self.newest or self.newest[0][0] < number:
                    self.newest.append((number, result))
        finally:
            with self.changed:
                self.done += 1
                self.changed.notify()

    def has_ended(self) -> bool:
        """Whether no result will come. After an error no worker waits for the next frame: the source may have none."""
        return len(self.ended) == len(self.workers) or (any(self.ended) and self.done == self.taken)

    def results(self) -> Iterator[B]:
        """The newest result each time, and the first error after it."""
        shown = 0
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self.newest or self.has_ended())
                if not self.newest:
                    break
                number, result = self.newest.popleft()
            if number > shown:
                shown = number
                yield result
            del result
        for error in self.ended:
            if error is not None:
                raise error

    def close(self) -> None:
        """End the threads after their frames."""
        self.closed = True
        for worker in self.workers:
            worker.join(timeout=5)
        if not any(worker.is_alive() for worker in self.workers):  # else one of them waits for a frame
            self.frames.close()
