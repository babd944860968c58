"""Results of a benchmark, and the environment they were computed in."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import torch

from mwdn.benchmark import training
from mwdn.benchmark.recipe import Benchmark
from mwdn.benchmark.robustness import Sweep
from mwdn.benchmark.scoring import MethodResult
from mwdn.benchmark.sets import Dataset
from mwdn.evaluation import Report
from mwdn.runtime.environment import describe_environment


@dataclass(frozen=True, eq=False)
class Results:
    """All results of a benchmark.

    Args:
        benchmark: the recipe.
        datasets: by name.
        methods: results by the data set's name, then the method's label.
        sweeps: robustness by the method's label.
        runs: folder of the training runs.
        device: that computed the results.
        command: command line, for the page.
    """

    benchmark: Benchmark
    datasets: dict[str, Dataset]
    methods: dict[str, dict[str, MethodResult]]
    sweeps: dict[str, Sweep]
    runs: Path
    device: torch.device
    command: str

    def report(self, name: str) -> Report:
        """The comparison on one data set."""
        protocol = self.datasets[name].protocol
        scores = {label: result.scores for label, result in self.methods[name].items()}
        return Report(protocol.name, protocol.variant, scores, self.missing(name), [])

    def missing(self, name: str) -> dict[str, str]:
        """Metrics that a method or more on a data set have no scores of, with the reason."""
        return {metric: why for result in self.methods[name].values() for metric, why in result.missing.items()}

    def training_seconds(self, name: str, label: str) -> float | None:
        """Training time of a network; ``None`` for a solver."""
        return training.seconds(self.runs / (self.datasets[name].recipe.trained_on or name) / label)


def environment(device: torch.device) -> dict[str, str]:
    """Commit, versions and hardware."""
    return {"commit": _commit(), "computed on": str(device), **describe_environment()}


def _commit() -> str:
    """Commit of the checkout that mwdn runs from, marked as dirty if files have changed since."""
    own = Path(__file__)
    git = ["git", "-C", str(own.parent)]
    try:  # another project's repository may hold the environment that mwdn is installed in
        subprocess.run([*git, "ls-files", "--error-unmatch", own.name], capture_output=True, check=True, timeout=20)
        call = [*git, "describe", "--always", "--dirty", "--abbrev=40"]
        return subprocess.run(call, capture_output=True, text=True, check=True, timeout=20).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "not a checkout"
