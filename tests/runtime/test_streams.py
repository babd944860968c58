"""Prefetching, the newest frame and the newest result of a source, and their memory."""

import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from mwdn import Calibration, Reconstructor
from mwdn.runtime.streams import latest, latest_results, prefetch
from mwdn.runtime.threads import use_threads
from mwdn.solvers import Wiener

WAIT = 30  # seconds until a test fails that should not have to wait

# --- Prefetch --------------------------------------------------------------------------------------------


def test_results_come_in_order_from_another_thread():
    with prefetch(lambda n: (n * n, threading.get_ident()), range(20)) as results:
        squares, threads = zip(*results, strict=True)
    assert squares == tuple(n * n for n in range(20))
    assert len(set(threads)) == 1
    assert threads[0] != threading.get_ident()


@pytest.mark.parametrize("depth", [1, 3])
def test_no_more_than_a_few_are_ahead(depth):
    taken = []
    with prefetch(lambda n: n, (taken.append(n) or n for n in range(20)), depth=depth) as results:
        for number, result in enumerate(results):
            assert result == number
            assert len(taken) == min(number + depth + 1, 20)


def test_stages_overlap():
    """The second item is processed while the first result is in use; otherwise both would wait for ever."""
    begun, used = threading.Event(), threading.Event()

    def work(n):
        if n == 1:
            begun.set()
            assert used.wait(WAIT)
        return n

    with prefetch(work, range(3)) as results:
        assert next(results) == 0
        assert begun.wait(WAIT)
        used.set()
        assert list(results) == [1, 2]


def test_error_is_raised_where_its_result_is_taken():
    with prefetch(lambda n: 6 // (3 - n), range(6)) as results:
        assert [next(results) for _ in range(3)] == [2, 3, 6]
        with pytest.raises(ZeroDivisionError):
            next(results)


def test_thread_ends_with_the_block():
    """The thread stops after its current item, whatever ended the block."""
    before, done = threading.active_count(), []

    def interrupted():
        with prefetch(done.append, range(100)) as results:
            next(results)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert threading.active_count() == before
    assert len(done) <= 3


# --- Latest -------------------------------------------------------------------------------------------


class Source:
    """A camera that takes frames 0, 1 ... only when the test allows it."""

    def __init__(self, count):
        self.count, self.allowed, self.taken = count, threading.Semaphore(0), 0

    def take(self, count):
        """Allow some frames, and wait until the camera is ready for the next."""
        goal = self.taken + count
        for _ in range(count):
            self.allowed.release()
        with self.asked:
            assert self.asked.wait_for(lambda: self.waiting == goal, WAIT)

    asked, waiting = threading.Condition(), -1

    def __iter__(self):
        for number in range(self.count):
            with self.asked:
                self.waiting = number
                self.asked.notify()
            assert self.allowed.acquire(timeout=WAIT)
            self.taken += 1
            yield number
        with self.asked:
            self.waiting = self.count
            self.asked.notify()


def test_newest_frame_wins():
    source = Source(10)
    with closing(latest(source)) as frames:
        source.allowed.release()
        assert next(frames) == 0
        source.take(4)  # frames 1 to 4, while the consumer is busy
        assert next(frames) == 4
        source.take(5)
        assert list(frames) == [9]  # the last frame is yielded although the source has ended


def test_frames_of_a_slow_source_all_come():
    source = Source(5)
    with closing(latest(source)) as frames:
        for number in range(5):
            source.allowed.release()
            assert next(frames) == number
        assert list(frames) == []


def test_source_without_frames():
    assert list(latest([])) == []


def test_error_of_the_source_comes_after_its_last_frame():
    def broken():
        yield 1
        raise OSError("unplugged")

    frames = latest(broken())
    assert next(frames) == 1
    with pytest.raises(OSError, match="unplugged"):
        next(frames)


def test_source_stops_with_its_consumer():
    ended, others = threading.Event(), set(threading.enumerate())

    def endless():
        try:
            while True:
                yield 0
        finally:
            ended.set()

    with closing(latest(endless())) as frames:
        assert next(frames) == 0
    assert ended.wait(WAIT)
    assert not any(thread.name.endswith("(run)") for thread in set(threading.enumerate()) - others)


# --- Newest result ------------------------------------------------------------------------------------


def results_of_each(finish, count, *, begin=lambda frame: None, fail_at=-1):
    """Results of a source that waits until each frame has begun before it delivers the next."""
    begun = threading.Semaphore(0)

    def source():
        for number in range(count):
            if number == fail_at:
                raise OSError("source")
            yield number
            assert begun.acquire(timeout=WAIT)

    def begin_one(frame):
        begun.release()
        begin(frame)
        return partial(finish, frame)

    return latest_results(begin_one, source(), workers=2)


def test_two_frames_are_in_progress_at_the_same_time():
    """Otherwise the barrier breaks."""
    together = threading.Barrier(2, timeout=WAIT)

    def finish(frame):
        together.wait()
        return frame

    assert list(results_of_each(finish, 2))[-1] == 1


def test_result_that_a_later_one_has_overtaken_is_dropped():
    shown = threading.Event()

    def finish(frame):
        if frame != 1:
            assert shown.wait(WAIT)
        return frame

    with closing(results_of_each(finish, 3)) as results:
        assert next(results) == 1
        shown.set()
        assert list(results) == [2]


def test_frames_are_begun_one_at_a_time_in_order():
    begun, busy = [], threading.Lock()

    def begin(frame):
        assert busy.acquire(blocking=False)
        begun.append(frame)
        busy.release()
        return lambda: frame

    results = list(latest_results(begin, range(200), workers=3))
    assert begun == sorted(begun)
    assert results == sorted(set(results))
    assert results[-1] == begun[-1] == 199


def fail(frame):
    if frame == 3:
        raise OSError("work")
    return frame


@pytest.mark.parametrize(
    "results",
    [
        lambda: results_of_each(fail, 4),
        lambda: results_of_each(lambda frame: frame, 4, begin=fail),
        lambda: results_of_each(lambda frame: frame, 4, fail_at=3),
    ],
    ids=["work", "begin", "source"],
)
def test_error_ends_the_results(results, request):
    with pytest.raises(OSError, match="source" if "source" in request.node.name else "work"):
        list(results())


def test_error_of_the_source_comes_after_the_result_of_its_last_frame():
    """A recording lost its last frame: the frame was still in progress when the source ended."""

    def source():
        yield 0
        raise OSError("ended")

    with closing(latest_results(lambda frame: lambda: time.sleep(0.1) or frame, source(), workers=2)) as results:
        assert next(results) == 0
        with pytest.raises(OSError, match="ended"):
            next(results)


def test_threads_are_those_of_the_caller_alone():
    def new_thread():
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(torch.get_num_threads).result()

    def use(count):
        use_threads(count)
        return torch.get_num_threads()

    mine, new, counts = torch.get_num_threads(), new_thread(), [3, 4, 5, 3]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(use, counts)) == counts
    assert (torch.get_num_threads(), new_thread()) == (mine, new)


# --- Memory -------------------------------------------------------------------------------------------


def resident():
    """Bytes of memory in use by this process."""
    path = Path("/proc/self/statm")
    if not path.exists():
        pytest.skip("Only Linux tells the memory of a process in /proc.")
    return 4096 * int(path.read_text().split()[1])


def test_frames_are_not_kept():
    alive = weakref.WeakSet()

    class Frame:
        pass

    def camera():
        for _ in range(1000):
            frame = Frame()
            alive.add(frame)
            yield frame
            del frame

    most = 0
    for frame in latest(camera()):
        most = max(most, len(alive))
        del frame
    assert 0 < most <= 3  # one in use, one waiting, one being taken
    assert len(alive) == 0


@pytest.fixture
def one_thread():
    """Frames this small have no work for two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("unchecked", "one_thread")
@pytest.mark.parametrize("count", [600, pytest.param(10_000, marks=pytest.mark.acceptance)])
def test_memory_is_steady_over_thousands_of_frames(generator, count):
    calibration = Calibration(torch.rand(1, 3, 32, 32, generator=generator) / 1024)
    frame = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    reconstruct = Reconstructor(Wiener(regularisation=1e-3), calibration, device="cpu")
    used = []
    for number, _ in enumerate(reconstruct.stream(frame.copy() for _ in range(count))):
        if number % (count // 10) == count // 10 - 1:
            used.append(resident())
    assert len(used) == 10
    # Keeping one picture per frame would take 0.8 count x 12 kB = 6 MB after the second value, for 600 frames.
    assert max(used[2:]) - used[1] < 4e6
