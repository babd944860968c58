"""Progress of a command on standard error: a bar for each phase on a terminal, a plain line a minute in a log."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import timedelta
from types import TracebackType
from typing import TypeVar

from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskProgressColumn, TextColumn
from rich.table import Column
from rich.text import Text

from mwdn.cli.terminal import console, note, notes

T = TypeVar("T")
Clock = Callable[[], float]
Parts = int | float

LINE_EVERY_S = 60.0
"""Seconds between two lines of a log: a phase that takes less writes none."""


@dataclass
class Phase:
    """One phase of a command.

    Args:
        title: what is done.
        total: number of its parts; ``None`` if unknown.
        first: number of parts that were done earlier and say nothing about the speed; ``None`` until it is known.
        start: time in seconds at which ``first`` was counted.
    """

    title: str
    total: Parts | None
    first: Parts | None
    start: float

    def __post_init__(self) -> None:
        self.done, self.updated, self.note = self.first or 0, self.start, ""

    def update(self, done: Parts, now: float) -> None:
        """Count the parts that are done."""
        if self.first is None:
            self.first, self.start = done, now
        self.done, self.updated = done, now

    def left(self, now: float) -> float | None:
        """Seconds left at the mean speed so far; ``None`` until a part is done, and when that time has passed."""
        if self.total is None or self.first is None or self.done <= self.first:
            return None
        at_update = (self.updated - self.start) * (self.total - self.done) / (self.done - self.first)
        left = at_update - (now - self.updated)
        return left if left >= 0 else None


class Progressing(AbstractContextManager["Progressing"]):
    """The phases of a command, one after the other: prints nothing itself."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self.clock = clock
        self.phase: Phase | None = None

    def start(self, title: str, total: Parts | None, first: Parts | None = 0) -> None:
        """Complete the phase before, if there is one, and start another; see `Phase`."""
        self.complete()
        self.phase = Phase(title, total, first, self.clock())

    def update(self, done: Parts, note: str = "", total: Parts | None = None) -> None:
        """Say how many parts are done, and something about them; ``total`` replaces that of the start."""
        if self.phase is not None:
            self.phase.update(done, self.clock())
            self.phase.note, self.phase.total = note, total or self.phase.total

    def complete(self) -> None:
        """Say that the phase is complete."""
        if self.phase is not None:
            total = self.phase.total or 1
            self.update(total, self.phase.note, total)

    def print(self, line: str) -> None:
        """Print a line above the bar."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Complete the last phase, unless an error ends it."""
        if kind is None:
            self.complete()


class Lines(Progressing):
    """A line a minute, for a log.

    Args:
        titles: also a line at the start of each phase.
        clock: time in seconds.
    """

    def __init__(self, *, titles: bool = False, clock: Clock = time.monotonic) -> None:
        super().__init__(clock)
        self.titles = titles
        self._printed = 0.0

    def start(self, title: str, total: Parts | None, first: Parts | None = 0) -> None:
        """Start a phase."""
        super().start(title, total, first)
        self._printed = self.clock()
        if self.titles:
            self.print(title)

    def update(self, done: Parts, note: str = "", total: Parts | None = None) -> None:
        """Print a line if the last one is a minute old."""
        super().update(done, note, total)
        now, phase = self.clock(), self.phase
        if phase is None or phase.total is None or now - self._printed < LINE_EVERY_S:
            return
        left = phase.left(now)
        time_left = "" if left is None else f"{_duration(left)} left"
        line = filter(None, (f"{phase.title}: {phase.done / phase.total:.0%}", time_left, phase.note))
        self.print(", ".join(line))
        self._printed = now

    def print(self, line: str) -> None:
        """Print a line."""
        note(line)


class Bars(Progressing):
    """A bar for each phase, for a terminal."""

    def __init__(self) -> None:
        super().__init__()
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(24),  # leaves room for the rest in 80 columns
            TaskProgressColumn(),
            _Time(Column(no_wrap=True)),
            TextColumn("{task.fields[phase].note}", markup=False),
            console=notes,
            redirect_stdout=console.is_terminal,  # otherwise it is a file, which must get what is printed meanwhile
        )

    def __enter__(self) -> "Bars":
        """Show the bars."""
        self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Leave the bars as they are."""
        super().__exit__(kind, error, _)
        self._bars.stop()

    def start(self, title: str, total: Parts | None, first: Parts | None = 0) -> None:
        """Show another bar, below the finished ones."""
        super().start(title, total, first)
        for task in self._bars.tasks:
            self._bars.remove_task(task.id)
            self._bars.refresh()
            self._bars.console.print(self._bars.make_tasks_table([task]))
        self._bars.add_task(escape(title), total=total, completed=int(first or 0), phase=self.phase)

    def update(self, done: Parts, note: str = "", total: Parts | None = None) -> None:
        """Move the last bar."""
        super().update(done, note, total)
        self._bars.update(self._bars.task_ids[-1], completed=done, total=total)

    def print(self, line: str) -> None:
        """Print a line above the bars."""
        self._bars.print(line, markup=False, highlight=False, soft_wrap=True)


class _Time(ProgressColumn):
    """Time since the start of a phase, and how much is left."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        phase: Phase = task.fields["phase"]
        left = None if task.finished else phase.left(time.monotonic())
        elapsed = _duration((task.finished_time if task.finished else task.elapsed) or 0)
        return Text(elapsed if left is None else f"{elapsed}, {_duration(left)} left", style="cyan")


def show_progress(*, enabled: bool = True, titles: bool = False) -> Progressing:
    """Bars on a terminal, `Lines` in a log, nothing if not ``enabled``; to be used in a ``with`` statement."""
    if notes.quiet or not enabled:
        return Progressing()
    return Bars() if notes.is_interactive else Lines(titles=titles)


def track(items: Sequence[T], title: str) -> Iterator[T]:
    """Iterate over items and show how many are done."""
    with show_progress() as progress:
        progress.start(title, len(items))
        for done, item in enumerate(items, 1):
            yield item
            progress.update(done)


def _duration(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
