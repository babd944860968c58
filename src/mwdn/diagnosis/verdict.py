"""A statement about a PSF, a capture or a picture."""

from dataclasses import dataclass
from typing import Literal

Subject = Literal["psf", "capture", "picture"]
State = Literal["good", "doubt", "unknown"]
"""``good``: nothing to do. ``doubt``: something is probably wrong. ``unknown``: this capture cannot tell."""


@dataclass(frozen=True)
class Verdict:
    """Result of a check.

    Args:
        subject: what it is about.
        topic: of `mwdn explain`, a section of docs/troubleshooting.md: ``"gamma"``, ``"another-camera"``.
        state: how sure, and whether something is wrong.
        text: one sentence that states the fact, and the number it comes from.
        value: what was detected, for programs: ``"srgb"``, ``"rggb"``, ``"rotate-180"``, ``"4"``; empty if nothing.
        options: command-line options to try, ready to paste: ``"--gamma srgb"``.
    """

    subject: Subject
    topic: str
    state: State
    text: str
    value: str = ""
    options: str = ""

    @property
    def sentence(self) -> str:
        """The statement, the options to try, and where to read more."""
        parts = [self.text, f"Try `{self.options}`." if self.options else ""]
        parts.append(f"Read `mwdn explain {self.topic}`." if self.state != "good" else "")
        return " ".join(filter(None, parts))
