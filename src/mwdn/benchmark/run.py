"""Run a benchmark from its recipe to its page, resuming an interrupted one."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from mwdn.benchmark.exports import csv_text, json_content
from mwdn.benchmark.locks import claim_parts, lock
from mwdn.benchmark.methods import Method
from mwdn.benchmark.pages import MARK, write_html, write_markdown
from mwdn.benchmark.recipe import Benchmark
from mwdn.benchmark.results import Results
from mwdn.benchmark.robustness import Sweep, check_axes, pairs_at, sweep
from mwdn.benchmark.scoring import MethodResult, identity, make_reconstructor, score
from mwdn.benchmark.sections import sections
from mwdn.benchmark.sets import Dataset, open_dataset
from mwdn.benchmark.training import check_networks, schedule_on, train
from mwdn.data.photographs import Photographs
from mwdn.evaluation import Perceptual
from mwdn.evaluation.alexnet import ALEXNET_MIN_PX, load_alexnet
from mwdn.io.files import refuse_foreign, write_text
from mwdn.io.listing import refuse_within
from mwdn.runtime.distributed import local_device
from mwdn.training.losses import NEED_ALEXNET
from mwdn.training.recipe import Schedule
from mwdn.training.report import Report

PAGE = "index.html"


@dataclass(frozen=True)
class Watch:
    """Callbacks that show the progress.

    Args:
        stage: called with the title of a new stage and its number of parts, 0 if unknown.
        done: called with the number of finished parts and a note.
    """

    stage: Callable[[str, int], None] = lambda title, parts: None
    done: Callable[[int, str], None] = lambda parts, note: None

    def track(self, title: str, rows: list[range]) -> Iterator[range]:
        """Iterate over rows as one stage."""
        self.stage(title, len(rows))
        self.done(0, "")
        for number, row in enumerate(rows):
            yield row
            self.done(number + 1, "")

    def training(self, name: str, label: str, schedule: Schedule) -> Callable[[int, int], None]:
        """Show the training of one network; returns a callback for its cached samples, a stage before the steps."""
        if not schedule.pool:
            self.stage(f"{name}: training {label}", schedule.steps)
        started = False

        def samples(done: int, total: int) -> None:
            nonlocal started
            if not started:
                self.stage(f"{name}: simulating samples for {label}", total)
            started = True
            self.done(done, "")
            if done == total:
                self.stage(f"{name}: training {label}", schedule.steps)

        return samples

    def report(self, report: Report) -> None:
        """Show a training step."""
        psnr = f", {report.validation.psnr:.2f} dB" if report.validation else ""
        self.done(report.step, f"loss {report.loss:.4f}{psnr}")


def run(
    benchmark: Benchmark,
    out: Path,
    *,
    device: str | None = None,
    lpips: bool | None = None,
    command: str = "",
    watch: Watch = Watch(),
) -> Results:
    """Make the data, train, score, measure robustness, and write the page.

    Finished pair files, networks and scores are kept, and an interrupted training continues from its last saved state.
    Several processes with one ``out`` share the networks, see `mwdn.benchmark.locks`.

    Args:
        benchmark: the recipe.
        out: folder for ``index.html``, ``benchmark.md``, ``benchmark.json`` and ``benchmark.csv``, and for what they
            are made from: the folders ``data``, ``runs``, ``scores`` and ``robustness``.
        device: where to compute; a GPU if there is one unless given.
        lpips: LPIPS and feature MSE: with or without them; ``None`` for them if their public weights are there, or
            True to download the weights otherwise.
        command: command line, for the page.
        watch: shows the progress.

    Raises:
        MwdnError: a file cannot be read, a method does not fit, training diverges, or ``out`` holds another benchmark.
    """
    torch_device = local_device(device)
    refuse_foreign(out, (PAGE, "benchmark.md", "benchmark.json", "benchmark.csv"), MARK)
    for photos in {folder for each in benchmark.data.values() for folder in (each.photos, each.test_photos) if folder}:
        refuse_within(photos, out)
    if NEED_ALEXNET & benchmark.loss.keys():
        load_alexnet(benchmark.alexnet or None, download=lpips is True)  # an error now instead of after the data
    with lock(out, "data"):
        datasets = {
            name: open_dataset(name, recipe, out / "data", torch_device, watch.track)
            for name, recipe in benchmark.data.items()
        }
    check_networks(benchmark, datasets)
    if benchmark.robustness.data:
        check_axes(benchmark.robustness, datasets[benchmark.robustness.data])
    _train_all(benchmark, datasets, out, torch_device, watch)
    files = benchmark.alexnet or None, benchmark.heads or None

    @cache
    def load_perceptual() -> Perceptual:
        return Perceptual.none() if lpips is False else Perceptual.load(*files, download=lpips is True)

    with lock(out, "scores"):  # one process at a time: run times are measured
        methods = {
            name: _score_all(benchmark, dataset, out, torch_device, watch, load_perceptual)
            for name, dataset in datasets.items()
        }
    sweeps = _sweep_all(benchmark, datasets, out, torch_device, watch)
    results = Results(benchmark, datasets, methods, sweeps, out / "runs", torch_device, command)
    with lock(out, "page"):
        write(results, out)
    return results


def write(results: Results, out: Path) -> None:
    """Write the page as HTML, Markdown, JSON and CSV.

    Raises:
        ImageError: a file cannot be written.
    """
    title = results.benchmark.title
    page = sections(results)
    write_html(out / PAGE, title, page)
    write_markdown(out / "benchmark.md", title, page)
    write_text(out / "benchmark.json", json.dumps(json_content(results), indent=1) + "\n")
    write_text(out / "benchmark.csv", csv_text(results))


def _train_all(
    benchmark: Benchmark, datasets: dict[str, Dataset], out: Path, device: torch.device, watch: Watch
) -> None:
    runs = {
        f"runs/{name}/{method.label}": (dataset, method)
        for name, dataset in datasets.items()
        if dataset.training is not None
        for method in benchmark.methods
        if method.learned
    }
    for part in claim_parts(out, list(runs)):
        dataset, method = runs[part]
        watched = watch.training(dataset.name, method.label, schedule_on(method, benchmark, dataset))
        train(method, dataset, benchmark, out / part, device=device, show=watch.report, samples=watched)


def _checkpoint(method: Method, dataset: Dataset, out: Path) -> Path | None:
    if not method.learned:
        return None
    return out / "runs" / (dataset.recipe.trained_on or dataset.name) / method.label / "best.safetensors"


def _score_all(
    benchmark: Benchmark,
    dataset: Dataset,
    out: Path,
    device: torch.device,
    watch: Watch,
    load_perceptual: Callable[[], Perceptual],
) -> dict[str, MethodResult]:
    """Scores of all methods on a data set, by label."""
    sides = dataset.protocol.crop(dataset.calibration.psf).shape[-2:]
    perceptual = Perceptual.none if min(sides) < ALEXNET_MIN_PX else load_perceptual  # `evaluate` says why
    results = {}
    watch.stage(f"{dataset.name}: scoring", len(benchmark.methods))
    for number, method in enumerate(benchmark.methods):
        watch.done(number, method.label)
        results[method.label] = score(
            method,
            _checkpoint(method, dataset, out),
            dataset,
            out / "scores" / dataset.name,
            device=device,
            perceptual=perceptual,
            shown=benchmark.shown,
        )
    return results


def _sweep_all(
    benchmark: Benchmark, datasets: dict[str, Dataset], out: Path, device: torch.device, watch: Watch
) -> dict[str, Sweep]:
    """Robustness of all methods, by label."""
    robustness = benchmark.robustness
    if not (robustness.data and robustness.sizes):
        return {}
    dataset, methods, sweeps = datasets[robustness.data], {m.label: m for m in benchmark.methods}, {}

    @cache
    def photographs() -> Photographs:  # read once, and only if a value is missing
        return Photographs(dataset.recipe.test_photos)

    @cache
    def pairs(axis: str, size: float) -> tuple[Tensor, Tensor]:
        watch.stage(f"{dataset.name}: pairs, {axis} {size:g}", 0)
        return pairs_at(dataset, photographs(), robustness.count, axis, size)

    labels = {f"robustness/{dataset.name}/{label}": label for label in methods}
    for part in claim_parts(out, list(labels)):
        method = methods[labels[part]]
        watch.stage(f"{dataset.name}: robustness of {method.label}", 0)
        checkpoint = _checkpoint(method, dataset, out)
        sweeps[method.label] = sweep(
            partial(make_reconstructor, method, checkpoint, dataset, device),
            identity(method, checkpoint, dataset),
            dataset,
            robustness,
            out / f"{part}.json",
            pairs,
        )
    return {label: sweeps[label] for label in methods}
