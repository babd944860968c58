"""Several processes at one benchmark."""

import multiprocessing
import shutil
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from mwdn.benchmark.locks import claim_parts, lock
from mwdn.errors import ParameterError

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # of other threads: none holds a lock


def work(folder, seconds, said):
    """Do four parts, each in so many seconds, and tell them."""
    for part in claim_parts(folder, ["a", "b", "c", "d"]):
        done = folder / part
        if not done.exists():
            with done.open("x"):  # fails if another is at it
                time.sleep(seconds)
        said.put(part)


@pytest.fixture
def start(tmp_path):
    """Start a process that does parts in so many seconds each; returns it and the queue of what it tells."""
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("no fork: a new Python takes seconds to start")
    context, processes = multiprocessing.get_context("fork"), []

    def start(seconds):
        said = context.SimpleQueue()
        processes.append(context.Process(target=work, args=(tmp_path, seconds, said)))
        processes[-1].start()
        return processes[-1], said

    yield start
    for process in processes:
        process.kill()
        process.join()


def test_each_part_is_done_once_and_all_wait_for_the_last(start):
    workers = [start(0.1) for _ in range(2)]
    for process, said in workers:
        process.join(600)
        assert process.exitcode == 0
        parts = []
        while not said.empty():
            parts.append(said.get())
        assert sorted(parts) == ["a", "b", "c", "d"]


def test_a_part_of_a_killed_process_is_another_ones(start, tmp_path):
    worker, _ = start(600)
    while not (tmp_path / "a").exists():
        time.sleep(0.05)
    parts = claim_parts(tmp_path, ["a", "b"])
    assert next(parts) == "b"
    worker.kill()
    worker.join()
    assert next(parts) == "a"
    assert list(parts) == []


def test_a_folder_that_cannot_be_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(ParameterError, match="must be a folder"), lock(tmp_path / "out", "data"):
        pass


def test_a_folder_that_another_process_removes_is_made_again(tmp_path):
    """A command that fails early removes its empty folders, while another one waits for a lock in them."""
    out = tmp_path / "out"
    with ThreadPoolExecutor() as pool, lock(out, "data"):

        def work():
            with lock(out, "data"):
                return (out / "locks").is_dir()

        waiting = pool.submit(work)
        time.sleep(0.2)
        shutil.rmtree(out)
        assert waiting.result(60)
