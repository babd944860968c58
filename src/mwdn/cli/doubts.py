"""Prints what is wrong with captures, PSF and pictures: each doubt once in full, its repetitions in one line."""

from collections import defaultdict
from collections.abc import Iterable

from mwdn.cli.terminal import counted, detail, warn
from mwdn.diagnosis import Verdict

NAMED = 3
"""Number of captures that a summary names."""


class Doubts:
    """Doubts of one run. Two are equal if they detect the same `value` under the same `topic`."""

    def __init__(self) -> None:
        self._captures: dict[tuple[str, str], list[str]] = defaultdict(list)

    def add(self, capture: str, verdicts: Iterable[Verdict]) -> None:
        """Print each doubt about a capture that has not been printed for an earlier one; with --verbose, the rest."""
        for verdict in verdicts:
            if verdict.state != "doubt":
                detail(f"{capture}: {verdict.sentence}")
            else:
                captures = self._captures[verdict.topic, verdict.value]
                captures.append(capture)
                if len(captures) == 1:
                    warn(f"{capture}: {verdict.sentence}")

    def summarise(self) -> None:
        """Print how many other captures each doubt concerns, too."""
        for (topic, _), (first, *others) in self._captures.items():
            if others:
                names = ", ".join(others[:NAMED]) + (" ..." if len(others) > NAMED else "")
                warn(f"{topic}: {counted(len(others), 'other capture')} like {first}: {names}")
