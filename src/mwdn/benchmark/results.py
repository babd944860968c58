"""Everything that a benchmark found, and where."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import torch

from mwdn.benchmark import training
from mwdn.benchmark.recipe import Benchmark
from mwdn.benchmark.robustness import Sweep
from mwdn.benchmark.scoring import Scored
from mwdn.benchmark.sets import Opened
from mwdn.evaluation import Report
from mwdn.runtime.environment import findings


@dataclass(frozen=True, eq=False)
class Found:
    """Everything that a benchmark found.

    Args:
        benchmark: its recipe.
        opened: data sets by their names.
        scored: by the data set's name, then the method's label.
        sweeps: robustness by the method's label.
        runs: folder of the trainings.
        device: where it was computed.
        command: that was given.
    """

    benchmark: Benchmark
    opened: dict[str, Opened]
    scored: dict[str, dict[str, Scored]]
    sweeps: dict[str, Sweep]
    runs: Path
    device: torch.device
    command: str

    def report(self, name: str) -> Report:
        """The comparison on one data set."""
        part, scored = self.opened[name].data.part(), self.scored[name]
        missing = next(iter(scored.values())).missing
        return Report(part.name, part.variant, {label: one.scores for label, one in scored.items()}, missing, [])

    def training_seconds(self, name: str, label: str) -> float | None:
        """How long a network was trained; ``None`` for a solver."""
        return training.seconds(self.runs / (self.opened[name].data.trained_on or name) / label)


def environment(device: torch.device) -> dict[str, str]:
    """Exact versions, and the hardware."""
    return {"commit": _commit(), "computed on": str(device), **findings()}


def _commit() -> str:
    """Of the checkout that mwdn runs from, with a mark if it has been changed since."""
    here = Path(__file__).parent
    call = ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        done = subprocess.run(call, capture_output=True, text=True, check=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return "not a checkout"
    return done.stdout.strip()
