"""What a benchmark found, as the sections of its page."""

import json
import statistics
from dataclasses import asdict, replace
from pathlib import Path

import torch
from rich.markup import escape
from rich.table import Table

from mwdn.benchmark import figures, training
from mwdn.benchmark.pages import Block, Code, Section
from mwdn.benchmark.recipe import AXES
from mwdn.benchmark.results import Found, environment
from mwdn.benchmark.scoring import Scored, measurements
from mwdn.benchmark.sets import Opened
from mwdn.evaluation import Report, bootstrap
from mwdn.evaluation.metrics import METRICS


def sections(found: Found) -> list[Section]:
    """The page."""
    parts = [Section("At a glance", _glance(found))]
    parts += [Section(name, _data_set(found, name)) for name in found.opened]
    if found.benchmark.ablation:
        parts.append(Section("Ablation", _ablation(found)))
    if found.sweeps:
        parts.append(Section("Robustness", _robustness(found)))
    return [*parts, Section("How it was made", _made(found))]


def _glance(found: Found) -> list[Block]:
    benchmark, schedule = found.benchmark, found.benchmark.schedule
    learned = sum(method.learned for method in benchmark.methods)
    table = _numbers(list(found.opened), "PSNR / dB, mean over the test pictures")
    reports = {name: found.report(name).methods for name in found.opened}
    means = {n: {label: s.summary("psnr")[0] for label, s in report.items()} for n, report in reports.items()}
    for method in benchmark.methods:
        cells = [
            _bold(f"{each[method.label]:.2f}", each[method.label] == max(each.values())) for each in means.values()
        ]
        table.add_row(escape(method.label), *cells)
    return [
        f"{learned} networks, each trained for {schedule.steps:,} steps of {schedule.batch} on the same pairs, and "
        f"{len(benchmark.methods) - learned} methods that need no training, scored alike on {len(found.opened)} data "
        "sets. Numbers of different data sets must not be compared with each other.",
        table,
    ]


def _numbers(heads: list[str], title: str) -> Table:
    """A line for each method, and columns of numbers."""
    table = Table("method", title=title)
    for head in heads:
        table.add_column(head, justify="right")
    return table


def _bold(text: str, best: bool) -> str:
    return f"[bold]{text}[/bold]" if best else text


def _data_set(found: Found, name: str) -> list[Block]:
    opened, report, scored = found.opened[name], found.report(name), found.scored[name]
    blocks: list[Block] = [_words(opened), report.table(_more(found, name))]
    blocks += [f"{metric} is missing: {reason}" for metric, reason in report.missing.items()]
    if found.benchmark.compared:
        blocks += [_differences(found.benchmark.compared, report)]
    shown = [opened.test[i] for i in range(len(next(iter(scored.values())).pictures))]
    if shown:
        blocks.append(_grid(opened, scored, torch.stack([p[1] for p in shown]), torch.stack([p[0] for p in shown])))
    if opened.data.captures:
        blocks += ["Real captures, of which nobody knows the scene (each picture scaled to its own brightest pixels):"]
        lines: list[figures.Line] = [(["measurement", *[""] * (len(seen := measurements(opened)) - 1)], seen)]
        lines += [([label, *[""] * (len(one.captures) - 1)], one.captures) for label, one in scored.items()]
        blocks.append(figures.grid(f"{name}-captures.jpg", lines, f"real captures of {name}"))
    if opened.training is not None:
        runs = {m.label: found.runs / name / m.label for m in found.benchmark.methods if m.learned}
        if runs:
            read = {label: training.curve(folder) for label, folder in runs.items()}
            blocks.append(figures.curves(f"{name}-curves.png", read, f"training on {name}"))
    return blocks


def _words(opened: Opened) -> str:
    data, (height, width) = opened.data, opened.calibration.size
    start = f"{height} x {width} pixels, PSF {opened.calibration.psf_hash}. "
    if data.trained_on:
        start += f"The networks are those of {data.trained_on}, untouched: no pair of this set was learned from. "
    if data.pairs:
        return start + f"{len(opened.test):,} recorded pairs are scored."
    off = ", ".join(f"{key} {value:g}" for key, value in asdict(data.deviation).items() if value) or "nothing"
    made = f"{data.train:,} pairs" if data.train else "new pairs at every step"
    return start + (
        f"Simulated: {made} for training, {data.validation:,} for validation and {data.test:,} for the test, of "
        f"photographs that no two of them share. The true camera differs from the calibration that the methods are "
        f"given by: {off}. Sensor: {data.sensor.full_well:,.0f} electrons, read noise {data.sensor.read_noise:g}."
    )


def _more(found: Found, name: str) -> dict[str, dict[str, str]]:
    scored = found.scored[name]
    columns = {"training": {label: _duration(found.training_seconds(name, label)) for label in scored}}
    cpu = {label: one.cpu for label, one in scored.items() if one.cpu is not None}
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
    metrics = [metric for metric in METRICS[:3] if metric not in report.missing]
    heads = [f"{metric} of {label} minus its" for metric in metrics]
    title = f"{label} against each, picture by picture: mean difference [95 % confidence]; bold where 0 is outside"
    table = _numbers(heads, title)
    own = report.methods[label].values
    for other, scores in report.methods.items():
        if other == label:
            continue
        cells = []
        for metric in metrics:
            gaps = [a - b for a, b in zip(own[metric], scores.values[metric], strict=True)]
            mean, low, high = bootstrap(gaps)
            cells.append(f"{_bold(f'{mean:+.3f}', low > 0 or high < 0)} \\[{low:+.3f}, {high:+.3f}]")
        table.add_row(escape(other), *cells)
    return table


def _grid(opened: Opened, scored: dict[str, Scored], scenes: torch.Tensor, seen: torch.Tensor) -> Block:
    part, count = opened.data.part(), len(scenes)
    blank = [""] * (count - 1)
    lines: list[figures.Line] = [(["scene", *blank], part.crop(scenes)), (["measurement", *blank], seen)]
    for label, one in scored.items():
        values = [f"{value:.1f} dB" for value in one.scores.values["psnr"][:count]]
        lines.append(([f"{label} {values[0]}", *values[1:]], part.crop(one.pictures)))
    words = f"{opened.name}: scene, measurement, and every method (each picture scaled to its own brightest pixels)"
    return figures.grid(f"{opened.name}.jpg", lines, words)


def _ablation(found: Found) -> list[Block]:
    blocks: list[Block] = ["The paper's steps from a single filter to its network, under the same budget:"]
    for name in found.opened:
        report = found.report(name)
        kept = replace(report, methods={label: report.methods[label] for label in found.benchmark.ablation})
        blocks += [name, kept.table(_more(found, name))]
    return blocks


def _robustness(found: Found) -> list[Block]:
    wanted = found.benchmark.robustness
    axes = {axis: sizes[-1] for axis, sizes in wanted.sizes.items()}
    heads = [f"{axis} {size:g}" for axis, size in axes.items()]
    table = _numbers(["as trained", *heads], "PSNR / dB as trained, and what the largest mismatch changes")
    for label, sweep in found.sweeps.items():
        start = statistics.fmean(next(iter(sweep.items()))[1][AXES[next(iter(sweep))]])
        ends = [statistics.fmean(sweep[axis][size]) - start for axis, size in axes.items()]
        table.add_row(escape(label), f"{start:.2f}", *(f"{end:+.2f}" for end in ends))
    pictures = [figures.robustness(label, found.sweeps) for label in found.sweeps]
    return [
        f"{wanted.count} test pictures of {wanted.data}. At the black line the camera is the one that networks were "
        "trained for, which already differs from its calibration; from there it differs more, in one way at a time, as "
        "if it had been knocked or warmed since. Methods are given the same calibration all along.",
        table,
        *pictures,
    ]


def _made(found: Found) -> list[Block]:
    benchmark = found.benchmark
    table = Table("method", "built with", "optimiser", "rate", "decay", "settings from", title="Methods")
    for method in benchmark.methods:
        options = ", ".join([method.name, *(f"{key} = {value}" for key, value in method.options.items())])
        own = training.settings(method, benchmark) if method.learned else None
        schedule = own.schedule if own else None
        cells = (
            [schedule.optimiser, f"{schedule.learning_rate:g}", f"{schedule.weight_decay:g}"] if schedule else [""] * 3
        )
        table.add_row(*map(escape, [method.label, options, *cells, own.source if own else "no training"]))
    facts = Table("what", "value", title="Versions and hardware")
    for key, value in environment(found.device).items():
        facts.add_row(escape(key), escape(value))
    return [
        f"One schedule for all networks: {json.dumps(asdict(benchmark.schedule))}. Loss: {json.dumps(benchmark.loss)}. "
        "Weights are those of the best validation. Confidence intervals: percentile bootstrap over the pictures.",
        table,
        facts,
        "The command:",
        Code(found.command or "mwdn.benchmark.run()"),
        "The recipe:",
        Code(Path(benchmark.path).read_text(encoding="utf-8").rstrip() if benchmark.path else ""),
    ]
