"""Benchmark results as JSON and CSV."""

import csv
import io
import json
import math
from dataclasses import asdict
from typing import Any

from mwdn.benchmark.results import Results, environment
from mwdn.evaluation.metrics import METRICS


def json_content(results: Results) -> dict[str, Any]:
    """All results except the pictures, in values that JSON can hold."""
    return {
        "title": results.benchmark.title,
        "command": results.command,
        "environment": environment(results.device),
        "benchmark": json.loads(json.dumps(asdict(results.benchmark))),
        "sets": {name: _dataset_content(results, name) for name in results.datasets},
        "robustness": results.sweeps,
    }


def _dataset_content(results: Results, name: str) -> dict[str, Any]:
    dataset, method_results = results.datasets[name], results.methods[name]
    return {
        "protocol": dataset.protocol.name,
        "variant": dataset.protocol.variant,
        "missing": results.missing(name),
        "data": dataset.identity,
        "methods": {
            label: {
                **result.scores.content(),
                "cpu": result.cpu.content() if result.cpu else None,
                "training_seconds": results.training_seconds(name, label),
            }
            for label, result in method_results.items()
        },
    }


def csv_text(results: Results) -> str:
    """One line per method and data set: means, confidence intervals and costs; a missing value is an empty cell."""
    text = io.StringIO()
    metrics = [f"{metric}{end}" for metric in METRICS for end in ("", "_low", "_high")]
    costs = ["learnable", "device", "seconds", "peak_bytes", "cpu_seconds", "cpu_peak_bytes", "training_seconds"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["data", "protocol", "variant", "pictures", "method", *metrics, *costs])
    for name, method_results in results.methods.items():
        report = results.report(name)
        for label, result in method_results.items():
            scores, cpu = result.scores, result.cpu or (result.scores if result.scores.device == "cpu" else None)
            numbers: list[float | str | None] = [number for metric in METRICS for number in scores.summary(metric)]
            numbers += [scores.learnable, scores.device, scores.median_seconds, scores.peak_bytes]
            numbers += [cpu.median_seconds, cpu.peak_bytes] if cpu else [None, None]
            row = [name, report.protocol, report.variant, report.pictures, label, *numbers]
            writer.writerow([_cell(value) for value in (*row, results.training_seconds(name, label))])
    return text.getvalue()


def _cell(value: Any) -> Any:  # noqa: ANN401
    return "" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value
