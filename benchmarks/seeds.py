"""One table over several seeds of a benchmark: means, and what the seed changes.

    python benchmarks/seeds.py runs/ablation-1 runs/ablation-2 runs/ablation-3 [--set mwdn-sim]

Each folder holds the `benchmark.json` of the same recipe. A method's score is the mean over pictures and seeds. The
interval is over pictures (bootstrap, each averaged over the seeds); the range is that of the seeds' means. The row
"mean picture" predicts the mean of the training scenes, for every measurement. The last tenth is the gain in validation
PSNR over the last tenth of the steps.
"""

import argparse
import json
from pathlib import Path
from statistics import fmean

import torch

from mwdn.data.pairs import PairFile
from mwdn.evaluation import Protocol, bootstrap
from mwdn.evaluation.metrics import measure


def mean_picture(folder, name, protocol, variant):
    """PSNR of the mean training scene on each test picture."""
    counts = json.loads((folder / "data" / f"{name}.json").read_text())
    file = PairFile(folder / "data" / f"{name}.h5")
    mean = torch.stack([file[row][1] for row in range(counts["train"])]).mean(0)[None]
    tests = range(counts["train"] + counts["validation"], len(file))
    return [float(measure(mean, file[row][1][None], protocol, variant=variant)["psnr"]) for row in tests]


def last_tenth(folder, name, label):
    """Gain in dB over the last tenth of a training, from the validations in its log."""
    log = folder / "runs" / name / label / "log.jsonl"
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    psnr = {line["step"]: line["psnr"] for line in lines if line["psnr"] is not None}
    if len(psnr) < 2:
        return None
    last = max(psnr)
    return psnr[last] - psnr[max(step for step in psnr if step <= 0.9 * last)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--set", default="mwdn-sim")
    arguments = parser.parse_args()
    sets = [json.loads((folder / "benchmark.json").read_text())["sets"][arguments.set] for folder in arguments.folders]
    labels = [label for label in sets[0]["methods"] if all(label in each["methods"] for each in sets)]
    print(
        "| method | learned numbers | PSNR / dB | LPIPS | range over seeds | last tenth / dB |\n" + "| --- " * 6 + "|"
    )
    for label in labels:
        rows = [each["methods"][label] for each in sets]
        pictures = [fmean(values) for values in zip(*(row["values"]["psnr"] for row in rows), strict=True)]
        lpips = fmean(fmean(row["values"]["lpips"]) for row in rows) if "lpips" in rows[0]["values"] else float("nan")
        means = [fmean(row["values"]["psnr"]) for row in rows]
        tenths = [last_tenth(folder, arguments.set, label) for folder in arguments.folders]
        tenth = f"{fmean(tenths):+.2f}" if None not in tenths else ""
        interval = "{:.2f} ({:.2f} to {:.2f})".format(*bootstrap(pictures))
        span = f"{min(means):.2f} to {max(means):.2f}"
        print(f"| {label} | {rows[0]['learnable']:,} | {interval} | {lpips:.3f} | {span} | {tenth} |")
    protocol, variant = Protocol.parse(sets[0]["protocol"]), sets[0]["variant"]
    constant = mean_picture(arguments.folders[0], arguments.set, protocol, variant)
    print("| mean picture | 0 | {:.2f} ({:.2f} to {:.2f}) | | | |".format(*bootstrap(constant)))


if __name__ == "__main__":
    main()
