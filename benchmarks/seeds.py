"""One table over several seeds of a benchmark: means, and what the seed changes.

    python benchmarks/seeds.py runs/ablation-1 runs/ablation-2 runs/ablation-3 [--set mwdn-sim]

Each folder holds the `benchmark.json` of a recipe. A score is the mean over pictures and over the folders that have the
method. The interval is over pictures (bootstrap, each averaged over the seeds); the range is that of the seeds' means.
The last tenth is the gain in validation PSNR over the last tenth of the steps.
"""

import argparse
import json
from pathlib import Path
from statistics import fmean

from mwdn.evaluation import bootstrap


def last_tenth(folder, name, label):
    """Gain in dB over the last tenth of a training, from the validations in its log."""
    log = folder / "runs" / name / label / "log.jsonl"
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    psnr = {line["step"]: line["psnr"] for line in lines if line["psnr"] is not None}
    if len(psnr) < 2:
        return None
    last = max(psnr)
    return psnr[last] - psnr[max(step for step in psnr if step <= 0.9 * last)]


def row(label, sets, folders, name):
    """One line of the table: a method's numbers over the folders that have it."""
    have = [
        (each["methods"][label], folder) for each, folder in zip(sets, folders, strict=True) if label in each["methods"]
    ]
    values = [method["values"] for method, _ in have]
    means = [fmean(each["psnr"]) for each in values]
    interval = bootstrap([fmean(scores) for scores in zip(*(each["psnr"] for each in values), strict=True)])
    lpips = f"{fmean(fmean(each['lpips']) for each in values):.3f}" if "lpips" in values[0] else ""
    seeds = f"{min(means):.2f} to {max(means):.2f}" if len(have) > 1 else ""
    tenths = [last_tenth(folder, name, label) for _, folder in have]
    tenth = "" if None in tenths else f"{fmean(tenths):+.2f}"
    cells = label, f"{have[0][0]['learnable']:,}", "{:.2f} ({:.2f} to {:.2f})".format(*interval), lpips, seeds, tenth
    return "| " + " | ".join(cells) + " |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--set", default="mwdn-sim")
    arguments = parser.parse_args()
    sets = [json.loads((folder / "benchmark.json").read_text())["sets"][arguments.set] for folder in arguments.folders]
    print(
        "| method | learned numbers | PSNR / dB | LPIPS | range over seeds | last tenth / dB |\n" + "| --- " * 6 + "|"
    )
    for label in dict.fromkeys(label for each in sets for label in each["methods"]):
        print(row(label, sets, arguments.folders, arguments.set))


if __name__ == "__main__":
    main()
