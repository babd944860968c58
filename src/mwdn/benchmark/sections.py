"""The sections of a benchmark's page."""

import json
import statistics
from dataclasses import asdict, replace
from pathlib import Path

import torch
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from mwdn.benchmark import figures, training
from mwdn.benchmark.methods import Method
from mwdn.benchmark.pages import Block, Code, Picture, Section
from mwdn.benchmark.recipe import SWEPT, Benchmark
from mwdn.benchmark.results import Results, environment
from mwdn.benchmark.scoring import MethodResult
from mwdn.benchmark.sets import Dataset
from mwdn.evaluation import Report, bootstrap
from mwdn.evaluation.metrics import METRICS


def sections(results: Results) -> list[Section]:
    """All sections of the page."""
    page = [Section("At a glance", _glance(results))]
    page += [Section(name, _dataset(results, name)) for name in results.datasets]
    if results.benchmark.ablation:
        page.append(Section("Ablation", _ablation(results)))
    if results.sweeps:
        page.append(Section("Robustness", _robustness(results)))
    return [*page, Section("How it was made", _provenance(results))]


def _glance(results: Results) -> list[Block]:
    """Mean PSNR of every method on every data set."""
    benchmark, schedule = results.benchmark, results.benchmark.schedule
    length = f"at most {schedule.epochs:,} epochs" if schedule.epochs else f"{schedule.steps:,} steps"
    learned = sum(method.learned for method in benchmark.methods)
    table = _method_table(list(results.datasets), "PSNR / dB, mean over the test pictures")
    means = [
        {label: scores.summary("psnr")[0] for label, scores in results.report(name).methods.items()}
        for name in results.datasets
    ]
    for method in benchmark.methods:
        label = method.label
        table.add_row(
            escape(label), *(_bold(f"{mean[label]:.2f}", mean[label] == max(mean.values())) for mean in means)
        )
    return [
        f"Networks: {learned}, each trained for {length} of {schedule.batch} on the same pairs. Methods without "
        f"training: {len(benchmark.methods) - learned}. Data sets: {len(results.datasets)}, scored under one protocol; "
        "scores on different ones are not comparable.",
        table,
    ]


def _method_table(columns: list[str], title: str) -> Table:
    """An empty table with a row per method and columns of numbers."""
    table = Table("method", title=title)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _bold(text: str, best: bool) -> str:
    return f"[bold]{text}[/bold]" if best else text


def _dataset(results: Results, name: str) -> list[Block]:
    """Scores, pictures and training curves on a data set."""
    dataset, report, method_results = results.datasets[name], results.report(name), results.methods[name]
    blocks: list[Block] = [_description(dataset), report.table(_costs(results, name))]
    blocks += [f"{metric} is missing: {reason}" for metric, reason in report.missing.items()]
    if results.benchmark.compared:
        blocks.append(_differences(results.benchmark.compared, report))
    if len(next(iter(method_results.values())).pictures):
        blocks.append(_grid(dataset, method_results))
    if dataset.recipe.captures:
        blocks += [
            "Real captures, whose scenes are unknown (each picture scaled to its own brightest pixels):",
            _capture_grid(dataset, method_results),
        ]
    if dataset.training is not None:
        runs = {
            method.label: results.runs / name / method.label for method in results.benchmark.methods if method.learned
        }
        if runs:
            curves = {label: training.curve(folder) for label, folder in runs.items()}
            blocks.append(figures.curves(f"{name}-curves.png", curves, f"training on {name}"))
    return blocks


def _description(dataset: Dataset) -> str:
    recipe, (height, width) = dataset.recipe, dataset.calibration.size
    start = f"{height} x {width} pixels, PSF {dataset.calibration.psf_hash}. "
    if recipe.trained_on:
        start += f"The networks are those of {recipe.trained_on}, not trained on any pair of this set. "
    if recipe.pairs:
        return start + f"{len(dataset.test):,} recorded pairs are scored."
    deviation = ", ".join(f"{key} {value:g}" for key, value in asdict(recipe.deviation).items() if value) or "nothing"
    count = f"{recipe.train:,} pairs" if recipe.train else "new pairs at every step"
    return start + (
        f"Simulated: {count} for training, {recipe.validation:,} for validation and {recipe.test:,} for the test, "
        f"from three separate sets of photographs. The true camera differs from the calibration that the methods get "
        f"by: {deviation}. Sensor: {recipe.sensor.full_well:,.0f} electrons, read noise {recipe.sensor.read_noise:g}."
    )


def _costs(results: Results, name: str) -> dict[str, dict[str, str]]:
    """Columns with training time, and time and memory on the CPU."""
    method_results = results.methods[name]
    columns = {"training": {label: _duration(results.training_seconds(name, label)) for label in method_results}}
    cpu = {label: result.cpu for label, result in method_results.items() if result.cpu is not None}
    if cpu:
        columns["ms / picture, CPU"] = {label: f"{1000 * scores.median_seconds:.1f}" for label, scores in cpu.items()}
        columns["memory, CPU"] = {
            label: f"{scores.peak_bytes / 2**20:,.0f} MiB" for label, scores in cpu.items() if scores.peak_bytes
        }
    return columns


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{seconds / 60:.1f} min"


def _differences(label: str, report: Report) -> Table:
    """Paired differences between one method and every other one."""
    metrics = [metric for metric in METRICS[:3] if metric not in report.missing]
    columns = [f"{metric} of {label} minus its" for metric in metrics]
    title = f"{label} against each, picture by picture: mean difference [95 % confidence]; bold where 0 is outside"
    table = _method_table(columns, title)
    values = report.methods[label].values
    for other, scores in report.methods.items():
        if other == label:
            continue
        cells = []
        for metric in metrics:
            differences = [a - b for a, b in zip(values[metric], scores.values[metric], strict=True)]
            mean, low, high = bootstrap(differences)
            cells.append(f"{_bold(f'{mean:+.3f}', low > 0 or high < 0)} \\[{low:+.3f}, {high:+.3f}]")
        table.add_row(escape(other), *cells)
    return table


def _grid(dataset: Dataset, method_results: dict[str, MethodResult]) -> Picture:
    """The first test pictures: scene, measurement and every method."""
    protocol, count = dataset.protocol, len(next(iter(method_results.values())).pictures)
    pairs = [dataset.test[index] for index in range(count)]
    measurements, scenes = (torch.stack(batch) for batch in zip(*pairs, strict=True))
    rows = [_row("scene", protocol.crop(scenes)), _row("measurement", measurements)]
    for label, result in method_results.items():
        psnr = [f"{value:.1f} dB" for value in result.scores.values["psnr"][:count]]
        rows.append(([f"{label} {psnr[0]}", *psnr[1:]], protocol.crop(result.pictures)))
    words = f"{dataset.name}: scene, measurement, and every method (each picture scaled to its own brightest pixels)"
    return figures.grid(f"{dataset.name}.jpg", rows, words)


def _capture_grid(dataset: Dataset, method_results: dict[str, MethodResult]) -> Picture:
    """The real captures and every method."""
    rows = [_row("measurement", dataset.captures)]
    rows += [_row(label, result.captures) for label, result in method_results.items()]
    return figures.grid(f"{dataset.name}-captures.jpg", rows, f"real captures of {dataset.name}")


def _row(title: str, pictures: Tensor) -> figures.Row:
    """Pictures of which the first one has a title."""
    return [title, *[""] * (len(pictures) - 1)], pictures


def _ablation(results: Results) -> list[Block]:
    blocks: list[Block] = ["The paper's steps from a single filter to its network, under the same budget:"]
    for name in results.datasets:
        report = results.report(name)
        selected = replace(report, methods={label: report.methods[label] for label in results.benchmark.ablation})
        blocks += [name, selected.table(_costs(results, name))]
    return blocks


def _robustness(results: Results) -> list[Block]:
    robustness = results.benchmark.robustness
    largest = {axis: max(sizes, key=lambda size: abs(size - SWEPT[axis])) for axis, sizes in robustness.sizes.items()}
    columns = ["as trained", *(f"{axis} {size:g}" for axis, size in largest.items())]
    table = _method_table(columns, "PSNR / dB as trained, and its change at the largest mismatch")
    for label, sweep in results.sweeps.items():
        axis, values = next(iter(sweep.items()))
        as_trained = statistics.fmean(values[SWEPT[axis]])
        changes = [statistics.fmean(sweep[axis][size]) - as_trained for axis, size in largest.items()]
        table.add_row(escape(label), f"{as_trained:.2f}", *(f"{change:+.2f}" for change in changes))
    return [
        f"{robustness.count} test pictures of {robustness.data}. At the black line the camera is that of the training, "
        "which already differs from its calibration. Away from it the camera differs more, in one way at a time, as if "
        "it had been knocked or warmed since. Methods always get the same calibration.",
        table,
        *(figures.robustness(label, results.sweeps) for label in results.sweeps),
    ]


def _provenance(results: Results) -> list[Block]:
    """Settings, versions, hardware, command and recipe."""
    benchmark = results.benchmark
    own = benchmark.published or benchmark.rates
    table = Table("method", "built with", "optimiser", "rate", "decay", "settings from", title="Methods")
    for method in benchmark.methods:
        options = ", ".join([method.name, *(f"{key} = {value}" for key, value in method.options.items())])
        table.add_row(*map(escape, [method.label, options, *_training_cells(method, benchmark)]))
    facts = Table("what", "value", title="Versions and hardware")
    for key, value in environment(results.device).items():
        facts.add_row(escape(key), escape(value))
    return [
        f"One schedule for all networks{', but with the optimiser, rate and decay in the table' if own else ''}: "
        f"{json.dumps(asdict(benchmark.schedule))}. Loss: {json.dumps(benchmark.loss)}"
        f"{_second_phase(benchmark)}. "
        "Weights are those of the best validation. Confidence intervals: percentile bootstrap over the pictures.",
        table,
        facts,
        "The command:",
        Code(results.command or "mwdn.benchmark.run()"),
        "The recipe:",
        Code(Path(benchmark.path).read_text(encoding="utf-8").rstrip() if benchmark.path else ""),
    ]


def _second_phase(benchmark: Benchmark) -> str:
    if not benchmark.later_loss:
        return ""
    return f", from the learning rate {benchmark.plateau.later:g} down {json.dumps(benchmark.later_loss)}"


def _training_cells(method: Method, benchmark: Benchmark) -> list[str]:
    if not method.learned:
        return ["", "", "", "no training"]
    settings = training.settings(method, benchmark)
    schedule = settings.schedule
    rate = f"{schedule.learning_rate:g}"
    if rates := benchmark.rates_of(method):
        rate = f"best of {', '.join(f'{tried:g}' for tried in rates)}"
    return [schedule.optimiser, rate, f"{schedule.weight_decay:g}", settings.source]
