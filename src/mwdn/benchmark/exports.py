"""What a benchmark found, as JSON and as CSV."""

import csv
import io
import json
import math
from dataclasses import asdict
from typing import Any

from mwdn.benchmark.results import Found, environment
from mwdn.evaluation.metrics import METRICS


def json_content(found: Found) -> dict[str, Any]:
    """Everything but the pictures, in values that JSON can hold."""
    sets = {}
    for name, opened in found.opened.items():
        part, scored = opened.data.part(), found.scored[name]
        methods = {
            label: {
                **one.scores.content(),
                "cpu": one.cpu.content() if one.cpu else None,
                "training_seconds": found.training_seconds(name, label),
            }
            for label, one in scored.items()
        }
        missing = next(iter(scored.values())).missing
        sets[name] = {"protocol": part.name, "variant": part.variant, "missing": missing, "data": opened.identity}
        sets[name]["methods"] = methods
    return {
        "title": found.benchmark.title,
        "command": found.command,
        "environment": environment(found.device),
        "benchmark": json.loads(json.dumps(asdict(found.benchmark))),
        "sets": sets,
        "robustness": found.sweeps,
    }


def csv_text(found: Found) -> str:
    """One line a method and data set: means with their intervals, costs; empty where something is missing."""
    text = io.StringIO()
    heads = [f"{metric}{end}" for metric in METRICS for end in ("", "_low", "_high")]
    costs = ["learnable", "device", "seconds", "peak_bytes", "cpu_seconds", "cpu_peak_bytes", "training_seconds"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["data", "protocol", "variant", "pictures", "method", *heads, *costs])
    for name, scored in found.scored.items():
        report = found.report(name)
        for label, one in scored.items():
            scores, cpu = one.scores, one.cpu or (one.scores if one.scores.device == "cpu" else None)
            numbers: list[float | str | None] = [number for metric in METRICS for number in scores.summary(metric)]
            numbers += [scores.learnable, scores.device, scores.median_seconds, scores.peak_bytes]
            numbers += [cpu.median_seconds, cpu.peak_bytes] if cpu else [None, None]
            row = [name, report.protocol, report.variant, report.pictures, label, *numbers]
            writer.writerow([_plain(value) for value in (*row, found.training_seconds(name, label))])
    return text.getvalue()


def _plain(value: Any) -> Any:  # noqa: ANN401
    return "" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value
