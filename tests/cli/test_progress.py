"""Progress: bars on a terminal, lines in a log."""

import io

import pytest
from rich.console import Console

from mwdn.cli import progress
from mwdn.cli.progress import Bars, Lines, Phase, show_progress, track
from mwdn.cli.terminal import counted


@pytest.fixture
def terminal(monkeypatch):
    """Standard error of a terminal of 100 columns, as text."""
    file = io.StringIO()
    monkeypatch.setattr(progress, "notes", Console(file=file, force_terminal=True, width=100, color_system=None))
    return file


@pytest.mark.parametrize(("count", "words"), [(0, "0 pairs"), (1, "1 pair"), (2, "2 pairs"), (3000, "3,000 pairs")])
def test_counted(count, words):
    assert counted(count, "pair") == words


def test_time_left_is_that_of_the_phase():
    """100 parts were done before; since then one in two seconds."""
    phase = Phase("Training", 200, 100, start=0.0)
    assert phase.left(5.0) is None
    phase.update(110, now=20.0)
    assert phase.left(20.0) == pytest.approx(180.0)
    assert phase.left(21.0) == pytest.approx(179.0)
    assert phase.left(201.0) is None  # the next part takes longer than all others together


def test_a_phase_that_resumes_learns_where_from_its_first_update():
    phase = Phase("Training", 200, None, start=0.0)
    phase.update(100, now=50.0)
    assert phase.left(50.0) is None
    phase.update(110, now=70.0)
    assert phase.left(70.0) == pytest.approx(180.0)


def test_bars_end_at_100_percent(terminal):
    with show_progress() as shown:
        assert isinstance(shown, Bars)
        shown.start("Simulating [samples]", 3)
        shown.update(1)
        shown.start("Training", None)
        shown.update(7, "loss 0.1", 10)
        shown.print("step 7: [b]")
    lines = terminal.getvalue().splitlines()
    assert any("Simulating [samples]" in line and "100%" in line for line in lines)
    assert all(word in lines[-2] for word in ("Training", "100%", "loss 0.1"))  # the last shows the cursor again
    assert any("step 7: [b]" in line for line in lines)


def test_an_interrupted_bar_stays_where_it_is(terminal):
    def interrupted():
        with show_progress() as shown:
            shown.start("Training", 4)
            shown.update(1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert "25%" in terminal.getvalue()
    assert "100%" not in terminal.getvalue()


def test_a_log_gets_a_line_a_minute(capsys):
    now = [0.0]
    lines = Lines(titles=True, clock=lambda: now[0])
    with lines:
        lines.start("Training", 100)
        for second in range(0, 150, 10):
            now[0] = float(second)
            lines.update(second // 10 + 1, "loss 0.1")
    assert capsys.readouterr().err.splitlines() == [
        "Training",
        "Training: 7%, 0:13:17 left, loss 0.1",
        "Training: 13%, 0:13:23 left, loss 0.1",
    ]


def test_short_work_leaves_nothing_in_a_log(capsys):
    assert list(track([1, 2], "Simulating")) == [1, 2]
    assert capsys.readouterr() == ("", "")
