"""Reconstructions in progress: a bounded queue, progress, cancellation, and results until they are forgotten."""

import secrets
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from mwdn.errors import MwdnError, without_traceback
from mwdn.preview.as_fields import as_fields
from mwdn.preview.limits import Limits, RefusedError, for_client
from mwdn.preview.result import Result

State = Literal["waiting", "reconstructing", "checking", "done", "failed", "cancelled"]
ENDED = ("done", "failed", "cancelled")

STOPPED = "The server is being stopped."

REMEMBERED = 1000
"""Jobs whose state is known, besides those in progress."""


@dataclass(eq=False)
class Job:
    """One reconstruction. Its id is a secret that only its client knows.

    Args:
        seconds: after which it is ended.
        size: bytes of its upload.
        look: format, exposure and white balance of its picture, as texts, unless a request says otherwise.
    """

    seconds: float
    id: str = field(default_factory=lambda: secrets.token_urlsafe(12))
    state: State = "waiting"
    progress: float = 0.0
    result: Result | None = None
    error: MwdnError | None = None
    cancelled: RefusedError | None = None  # why it is to end
    deadline: float = float("inf")
    size: int = 0
    look: dict[str, str] = field(default_factory=dict)
    _listeners: list[Callable[[], None]] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def when_ended(self, call: Callable[[], None]) -> None:
        """Call a function once the job has ended, in any thread; at once if it has."""
        with self._lock:
            if self.state not in ENDED:
                self._listeners.append(call)
                return
        call()

    def end(self, state: State, error: MwdnError | None = None) -> None:
        """Set the last state, and call the listeners."""
        with self._lock:
            self.error, self.state = error and without_traceback(error), state
            self.result = self.result if state == "done" else None
            listeners, self._listeners = self._listeners, []
        for call in listeners:
            call()

    def advance(self, progress: float) -> None:
        """Called after each iteration of a solver: ends a job that was cancelled or takes too long.

        Raises:
            RefusedError: it was cancelled, or its time is over.
        """
        if self.cancelled is not None:
            raise self.cancelled
        if time.monotonic() > self.deadline:
            raise RefusedError(
                504,
                f"The reconstruction takes longer than {self.seconds:g} s, the server's limit. Use fewer "
                "`iterations`, a larger `bin`, or a faster `method`: wiener, universal-small.",
            )
        self.progress = min(max(progress, self.progress), 1.0)

    def content(self) -> dict[str, Any]:
        """For JSON."""
        content: dict[str, Any] = {"id": self.id, "state": self.state, "progress": round(self.progress, 3)}
        if self.error is not None:
            content["error"] = as_fields(str(self.error))
        if self.result is not None:
            content["report"] = self.result.report
        return content


class Jobs:
    """The queue, and the threads that work on it."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._changed, self._is_closed = threading.Condition(), False
        self._jobs: OrderedDict[str, Job] = OrderedDict()
        self._queue: deque[tuple[Job, Callable[[Job], None]]] = deque()
        self._threads = [threading.Thread(target=self._work, daemon=True) for _ in range(limits.at_once)]
        for thread in self._threads:
            thread.start()

    def submit(self, work: Callable[[Job], None], *, size: int = 0) -> Job:
        """Queue a reconstruction.

        Args:
            work: sets the job's ``result``; called in another thread.
            size: bytes that are kept while it waits.

        Raises:
            RefusedError: too many wait.
        """
        job = Job(self.limits.seconds, size=size)
        with self._changed:
            if self._is_closed:
                raise RefusedError(503, STOPPED)
            kept = sum(waiting.size for waiting, _ in self._queue)
            if len(self._queue) >= self.limits.waiting or kept + size > self.limits.waiting_bytes:
                raise RefusedError(
                    503,
                    f"{len(self._queue)} requests wait already; the server's limits are {self.limits.waiting} and "
                    f"{self.limits.waiting_bytes:,} bytes. Try again in a few seconds.",
                )
            self._jobs[job.id] = job
            self._queue.append((job, work))
            self._changed.notify()
        return job

    def keep(self, result: Result) -> Job:
        """A job that is done already: a live picture that somebody wants to keep."""
        job = Job(self.limits.seconds, progress=1.0, result=result)
        job.end("done")
        with self._changed:
            self._jobs[job.id] = job
        self._forget()
        return job

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._is_closed)
                if not self._queue:
                    return
                job, work = self._queue.popleft()
            self._run(job, work)
            del job, work  # else an upload would be kept until the next one

    def _run(self, job: Job, work: Callable[[Job], None]) -> None:
        try:
            job.deadline = time.monotonic() + job.seconds
            job.advance(0.0)
            job.state = "reconstructing"
            work(job)
            job.advance(1.0)
            job.end("done")
        except BaseException as error:  # a defect of this package must not end the server
            told = for_client(error, "reconstruction")
            job.end("cancelled" if job.cancelled and told is error else "failed", told)
        self._forget()

    def _forget(self) -> None:
        with self._changed:
            ended = [job for job in self._jobs.values() if job.state in ENDED]
            size = sum(job.result.size for job in ended if job.result)
            for job in ended:
                if size > self.limits.result_bytes and job.result:
                    size -= job.result.size
                    job.result = None
            for job in ended[:-REMEMBERED]:
                del self._jobs[job.id]

    def get(self, id: str) -> Job:
        """A job by its id.

        Raises:
            RefusedError: no such job.
        """
        job = self._jobs.get(id)
        if job is None:
            raise RefusedError(404, "No such job: it was never there, or is forgotten. Send the capture again.")
        return job

    def result(self, id: str) -> Result:
        """The result of a job; its picture is there before it is checked.

        Raises:
            RefusedError: no such job, or it has none.
        """
        job = self.get(id)
        if job.result is None:
            why = "is forgotten; send the capture again" if job.state == "done" else f"is not there: {job.state}"
            raise RefusedError(404, f"The job's result {why}.")
        return job.result

    def cancel(self, id: str, why: RefusedError | None = None) -> Job:
        """End a job: before its start, or after the iteration in progress."""
        job = self.get(id)
        job.cancelled = why = why or RefusedError(409, "The reconstruction was cancelled.")
        with self._changed:
            waiting = next((item for item in self._queue if item[0] is job), None)
            if waiting is not None:
                self._queue.remove(waiting)
                job.end("cancelled", why)
        return job

    @property
    def waiting(self) -> int:
        """Number of jobs that wait."""
        return len(self._queue)

    @property
    def running(self) -> int:
        """Number of jobs in progress."""
        with self._changed:
            return sum(job.state in ("reconstructing", "checking") for job in self._jobs.values())

    def close(self) -> None:
        """Cancel all jobs, and wait for the iterations in progress."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        for id in list(self._jobs):
            self.cancel(id, RefusedError(503, STOPPED))
        for thread in self._threads:
            thread.join(timeout=10)
