"""One network of a benchmark on one data set: settings, training, and what it took."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

import torch

from mwdn.benchmark.published import PUBLISHED
from mwdn.benchmark.recipe import Benchmark, Method
from mwdn.benchmark.sets import Opened
from mwdn.errors import ParameterError
from mwdn.io.files import save_text
from mwdn.networks import NETWORKS
from mwdn.training.recipe import OPTIMISERS, Recipe, Schedule
from mwdn.training.trainer import Report, Trainer
from mwdn.types import Size

CLOCK = "clock.json"
"""Seconds that a run has trained, up to its last saved state."""


@dataclass(frozen=True)
class Settings:
    """How one network is trained.

    Args:
        schedule: its own.
        source: where optimiser and learning rate come from.
    """

    schedule: Schedule
    source: str


def settings(method: Method, benchmark: Benchmark) -> Settings:
    """The benchmark's schedule, with the optimiser that the network's source names where it does; the budget stays."""
    found = PUBLISHED.get(method.name) if benchmark.published else None
    if found is None:
        return Settings(benchmark.schedule, "the recipe's")
    optimiser = str(found.optimiser).lower()
    changes: dict[str, Any] = {"weight_decay": float(found.weight_decay)}
    if optimiser in OPTIMISERS:
        changes["optimiser"] = optimiser
    factor = ""
    if found.rate is not None:
        changes["learning_rate"] = float(found.rate) * benchmark.rate_factor
        factor = f"; its rate times {benchmark.rate_factor:g}" if benchmark.rate_factor != 1 else ""
    return Settings(replace(benchmark.schedule, **changes), f"{found.source}{factor}")


def options(method: Method, size: Size) -> dict[str, Any]:
    """What a network is built with for pictures of this size, which those are told that learn a PSF of it."""
    if "size" in signature(NETWORKS[method.name]).parameters:
        return {"size": list(size), **method.options}
    return method.options


def train(
    method: Method,
    opened: Opened,
    benchmark: Benchmark,
    folder: Path,
    *,
    device: torch.device,
    show: Callable[[Report], None],
) -> Path:
    """Train a network to the end of the budget, from where it was stopped; if it was there already, do nothing.

    Args:
        method: the network.
        opened: the data set.
        benchmark: the recipe.
        folder: of the run.
        device: where to train.
        show: told of each step.

    Returns:
        The checkpoint: the weights of the best validation.

    Raises:
        MwdnError: as for `mwdn.training.trainer.Trainer`; or the data set is for tests alone.
    """
    if opened.training is None:
        raise ParameterError(f"Nothing is trained on `{opened.name}`: its networks are those of `trained_on`.")
    training, validation = opened.training
    schedule = replace(settings(method, benchmark).schedule, validation=len(validation))
    recipe = Recipe({"name": method.name, **options(method, opened.calibration.size)}, schedule, benchmark.loss)
    trainer = Trainer(
        recipe,
        opened.calibration,
        training,
        folder,
        validation=validation,
        device=device,
        alexnet=Path(benchmark.alexnet) if benchmark.alexnet else None,
    )
    before, start = seconds(folder) or 0.0, time.perf_counter()

    def told(report: Report) -> None:
        if report.validation is not None:  # its state has just been saved
            passed = before + time.perf_counter() - start
            save_text(folder / CLOCK, json.dumps({"step": report.step, "seconds": passed}))
        show(report)

    trainer.run(told)
    return folder / "best.safetensors"


def seconds(folder: Path) -> float | None:
    """How long a run has trained, with its validations; steps that an interruption undid are not counted."""
    path = folder / CLOCK
    return float(json.loads(path.read_text(encoding="utf-8"))["seconds"]) if path.is_file() else None


def curve(folder: Path) -> tuple[list[tuple[int, float]], list[tuple[int, float]]]:
    """Loss of each step, and PSNR of each validation, of a run's log."""
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    losses = [(int(line["step"]), float(line["loss"])) for line in lines]
    return losses, [(int(line["step"]), float(line["psnr"])) for line in lines if line["psnr"] is not None]
