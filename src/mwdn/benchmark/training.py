"""Training of one network of a benchmark on one data set."""

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from inspect import signature
from itertools import combinations
from pathlib import Path
from typing import Any, cast

import torch

from mwdn.benchmark.methods import Method
from mwdn.benchmark.published import PUBLISHED
from mwdn.benchmark.recipe import Benchmark
from mwdn.benchmark.sets import Dataset
from mwdn.data.recorded import RecordedPairs
from mwdn.errors import DivergenceError, ParameterError
from mwdn.io.files import write_text
from mwdn.io.reading import LOG_BYTES, parse_json, read_json, read_text, unexpected_content
from mwdn.networks import NETWORKS
from mwdn.networks.empty import build_empty
from mwdn.training.network import check_colours, stored_psf
from mwdn.training.recipe import Recipe, Schedule
from mwdn.training.report import Report
from mwdn.training.tasks import pair_tasks, with_stored_psf
from mwdn.training.trainer import Trainer
from mwdn.training.validation import Validator

CLOCK = "clock.json"
"""File with the training time in seconds, up to the last saved state."""


@dataclass(frozen=True)
class Settings:
    """Training settings of a network.

    Args:
        schedule: its training schedule.
        source: where its optimiser and learning rate come from.
    """

    schedule: Schedule
    source: str


def settings(method: Method, benchmark: Benchmark) -> Settings:
    """The benchmark's schedule with the optimiser settings that the network's authors published; the budget stays."""
    published = PUBLISHED.get(method.name) if benchmark.published else None
    if published is None:
        return Settings(replace(benchmark.schedule, **method.schedule), "the recipe's")
    changes: dict[str, Any] = {"optimiser": published.optimiser, "weight_decay": published.weight_decay}
    factor = ""
    if published.rate is not None:
        changes["learning_rate"] = published.rate * benchmark.rate_factor
        factor = f"; its rate times {benchmark.rate_factor:g}" if benchmark.rate_factor != 1 else ""
    return Settings(replace(benchmark.schedule, **changes | method.schedule), f"{published.source}{factor}")


def schedule_on(method: Method, benchmark: Benchmark, dataset: Dataset) -> Schedule:
    """The schedule of a network on a data set, its epochs as steps with a validation after each."""
    schedule = settings(method, benchmark).schedule
    if not (schedule.epochs and dataset.training):
        return schedule
    steps = math.ceil(len(cast(RecordedPairs, dataset.training[0])) / schedule.batch)
    return replace(schedule, steps=schedule.epochs * steps, validate_every=steps)


def options(method: Method, dataset: Dataset) -> dict[str, Any]:
    """Options to build a network with; includes what it must know of the data set: picture size, grey pairs."""
    known: dict[str, Any] = {"size": list(dataset.calibration.size)}
    if dataset.channels == 1:
        known["channels"] = 1
    parameters = signature(NETWORKS[method.name]).parameters
    return {key: value for key, value in known.items() if key in parameters} | method.options


def check_networks(benchmark: Benchmark, datasets: Mapping[str, Dataset]) -> None:
    """Check that the networks differ, and take the channels of the pairs and captures that they are tested on.

    Raises:
        ParameterError: two are the same; or the recipe gives one another number, or it is trained on pairs of another
            number.
        MwdnError: captures cannot be read, or do not fit the camera.
    """
    learned = [method for method in benchmark.methods if method.learned]
    _refuse_repetition(learned, benchmark)
    for name, dataset in datasets.items():
        trained_on = dataset.recipe.trained_on
        networks = [{"name": method.name, **options(method, datasets[trained_on or name])} for method in learned]
        way_out = f"Set `channels = {dataset.channels}` of the network."
        if trained_on:
            way_out = f"It is trained on `{trained_on}`, whose pairs must be like these: all grey, or all in colour."
        for network in networks:
            check_colours(network, dataset.channels, of=f"`{name}`", way_out=way_out)
        if dataset.recipe.captures and networks:
            colours = dataset.captures.shape[1]
            way_out = "For a grey camera set `grey = true` in its camera file; for a mosaic, `mosaic`."
            for network in networks:
                check_colours(network, colours, of=f"the captures of `{name}`", way_out=way_out)


def _refuse_repetition(learned: list[Method], benchmark: Benchmark) -> None:
    """Raise a `ParameterError` if two lines of the recipe are one training: `--seed` may equal the seed of a line."""
    for one, other in combinations(learned, 2):
        first, second = ((method.name, method.options, settings(method, benchmark)) for method in (one, other))
        if first == second:
            raise ParameterError(
                f"`{one.label}` and `{other.label}` are the same network with the same seed "
                f"({first[2].schedule.seed}). Remove one of them, or choose another seed."
            )


def train(
    method: Method,
    dataset: Dataset,
    benchmark: Benchmark,
    folder: Path,
    *,
    device: torch.device,
    show: Callable[[Report], None],
    samples: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Train a network to the end of the budget, resuming an interrupted run; a finished run is left as it is.

    Args:
        method: the network.
        dataset: its training and validation pairs.
        benchmark: the recipe.
        folder: of the run.
        device: where to train.
        show: called after each step.
        samples: called with the number of cached samples that are done and their total, if the recipe has a `pool`.

    Returns:
        The checkpoint with the best validation.

    Raises:
        MwdnError: as for `mwdn.training.trainer.Trainer`; or the data set has no training pairs.
    """
    if dataset.training is None:
        raise ParameterError(f"Nothing is trained on `{dataset.name}`: its networks are those of `trained_on`.")
    schedule = replace(schedule_on(method, benchmark, dataset), validation=len(dataset.training[1]))
    if benchmark.rates_of(method):
        schedule = replace(schedule, learning_rate=_best_rate(method, dataset, benchmark, schedule, folder, device))
    trainer = _trainer(method, dataset, benchmark, schedule, folder, device)
    seconds_before, start = seconds(folder) or 0.0, time.perf_counter()

    def save_time() -> None:
        total = seconds_before + time.perf_counter() - start
        write_text(folder / CLOCK, json.dumps({"step": trainer.step, "seconds": total}))

    def after_step(report: Report) -> None:
        if report.validation is not None:  # the state has just been saved
            save_time()
        show(report)

    try:
        trainer.run(after_step, samples=samples)
    except KeyboardInterrupt:  # here, too
        save_time()
        raise
    return folder / "best.safetensors"


def _trainer(
    method: Method, dataset: Dataset, benchmark: Benchmark, schedule: Schedule, folder: Path, device: torch.device
) -> Trainer:
    assert dataset.training is not None
    training, validation = dataset.training
    network = {"name": method.name, **options(method, dataset)}
    division = dataset.recipe.division()
    recipe = Recipe(network, schedule, benchmark.loss, benchmark.plateau, benchmark.later_loss, division)
    stored = stored_psf(recipe, dataset.calibration, device)
    psf = dataset.calibration.psf.to(device) if stored is None else stored
    if schedule.pool and isinstance(training, RecordedPairs) and getattr(build_empty(**network), "align", False):
        # It is tested with a PSF aligned to each capture.
        training, validation = (replace(part, aligned=True, poses={}) for part in (training, validation))
    task, held_out = pair_tasks(training, validation, schedule)
    return Trainer(
        recipe,
        with_stored_psf(task, stored),
        out=folder,
        calibration=dataset.calibration,
        validator=Validator(recipe, with_stored_psf(held_out, stored), psf),
        device=device,
        alexnet=Path(benchmark.alexnet) if benchmark.alexnet else None,
    )


def _best_rate(
    method: Method, dataset: Dataset, benchmark: Benchmark, schedule: Schedule, folder: Path, device: torch.device
) -> float:
    """The rate that is best on validation after `trial` of the steps; finished trials are not repeated."""
    steps = max(1, round(benchmark.trial * schedule.steps))
    every = min(schedule.validate_every, steps)
    scores: dict[float, float] = {}
    for rate in benchmark.rates:
        short = replace(schedule, learning_rate=rate, steps=steps, epochs=0, validate_every=every)
        warmup = min(short.warmup, steps // 10)
        trial_folder = folder / f"rate-{rate:g}"
        diverged = trial_folder / "diverged"
        if diverged.is_file() and read_text(diverged) == str(steps):
            scores[rate] = -math.inf
            continue
        trial = _trainer(method, dataset, benchmark, replace(short, warmup=warmup), trial_folder, device)
        try:
            scores[rate] = trial.run()
        except DivergenceError:
            scores[rate] = -math.inf
            write_text(diverged, str(steps))
    return max(scores, key=lambda rate: scores[rate])


def seconds(folder: Path) -> float | None:
    """Training time of a run, validations included; steps lost in an interruption do not count."""
    path = folder / CLOCK
    if not path.is_file():
        return None
    with unexpected_content(path):
        return float(read_json(path)["seconds"])


def curve(folder: Path) -> tuple[list[tuple[int, float]], list[tuple[int, float]]]:
    """Loss of each step and PSNR of each validation, from a run's log."""
    path = folder / "log.jsonl"
    with unexpected_content(path):
        lines = [parse_json(line, path) for line in read_text(path, most=LOG_BYTES).splitlines()]
        losses = [(int(line["step"]), float(line["loss"])) for line in lines]
        return losses, [(int(line["step"]), float(line["psnr"])) for line in lines if line["psnr"] is not None]
