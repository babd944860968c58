"""One table over several seeds of a benchmark: means, and what the seed changes.

    python benchmarks/seeds.py runs/ablation-1 runs/ablation-2 runs/ablation-3 [--set mwdn-sim] [--than mwdn]
    python benchmarks/seeds.py benchmarks/results/ablation-long*.json

Each argument is the folder of a benchmark, or a record: a copy of the folder's `benchmark.json`. A score is the mean
over pictures and over the runs that have the method. The interval is over pictures (bootstrap, each averaged over the
runs); the range is that of the runs' means. The last tenth is the gain in validation PSNR over the last tenth of the
steps, which is in folders only. With `--than`, the last column is the gain in dB over that method on the same pictures.
"""

import argparse
import json
from pathlib import Path
from statistics import fmean

from mwdn.evaluation import bootstrap


def last_tenth(folder, name, label):
    """Gain in dB over the last tenth of a training, from the validations in its log."""
    log = folder / "runs" / name / label / "log.jsonl"  # a record has none
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    psnr = {line["step"]: line["psnr"] for line in lines if line["psnr"] is not None}
    if len(psnr) < 2:
        return None
    last = max(psnr)
    return psnr[last] - psnr[max(step for step in psnr if step <= 0.9 * last)]


def mean_scores(label, sets):
    """PSNR of each picture, averaged over the runs that have the method."""
    values = [each["methods"][label]["values"]["psnr"] for each in sets if label in each["methods"]]
    return [fmean(scores) for scores in zip(*values, strict=True)]


def interval(scores):
    """Mean of the pictures' scores, with its confidence interval."""
    return "{:.2f} ({:.2f} to {:.2f})".format(*bootstrap(scores))


def row(label, sets, folders, name, than):
    """One line of the table: a method's numbers over the runs that have it."""
    have = [
        (each["methods"][label], folder) for each, folder in zip(sets, folders, strict=True) if label in each["methods"]
    ]
    values = [method["values"] for method, _ in have]
    means = [fmean(each["psnr"]) for each in values]
    scores = mean_scores(label, sets)
    measured = [each["lpips"] for each in values if None not in each.get("lpips", [None])]
    lpips = f"{fmean(map(fmean, measured)):.3f}" if measured else ""
    seeds = f"{min(means):.2f} to {max(means):.2f}" if len(have) > 1 else ""
    tenths = [last_tenth(folder, name, label) for _, folder in have]
    tenth = "" if None in tenths else f"{fmean(tenths):+.2f}"
    cells = [label, f"{have[0][0]['learnable']:,}", interval(scores), lpips, str(len(have)), seeds, tenth]
    if than:
        other = mean_scores(than, sets)
        cells.append(interval([one - two for one, two in zip(scores, other, strict=True)]))
    return "| " + " | ".join(cells) + " |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--set", default="mwdn-sim")
    parser.add_argument("--than")
    arguments = parser.parse_args()
    files = [run / "benchmark.json" if run.is_dir() else run for run in arguments.runs]
    contents = [json.loads(file.read_text())["sets"] for file in files]
    for file, content in zip(files, contents, strict=True):
        if arguments.set not in content:
            parser.error(f"`{file}` has no set '{arguments.set}'. Known: {', '.join(content)}.")
    sets = [content[arguments.set] for content in contents]
    columns = ["method", "learned numbers", "PSNR / dB", "LPIPS", "runs", "range over runs", "last tenth / dB"]
    columns += [f"over {arguments.than} / dB"] if arguments.than else []
    print("| " + " | ".join(columns) + " |\n" + "| --- " * len(columns) + "|")
    for label in dict.fromkeys(label for each in sets for label in each["methods"]):
        print(row(label, sets, arguments.runs, arguments.set, arguments.than))


if __name__ == "__main__":
    main()
