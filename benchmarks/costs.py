"""Operations, memory and time of every method for one picture, beside each other.

    python benchmarks/costs.py [--size 320x320] [--repeats 2] [--methods mwdn updn ...]

Networks are at their published width, with random weights, prepared for one camera; float32, one thread. Time is
processor time, the shortest of ``--repeats`` rounds in which all methods take turns, after one to warm up: on a busy
machine the ratios hold, not the seconds. GFLOP are those of convolutions and Fourier transforms. Memory is the peak
of a process that reconstructs one picture, less that after the imports. Writes `benchmarks/results/costs.json`.
"""

import argparse
import json
import time
from pathlib import Path

import torch

import arithmetic
import engine
from mwdn.networks import NETWORKS, build

METHODS = [
    "wiener",
    "unet",
    "wiener-unet",
    "mwdn",
    "mwdn-cpsf",
    "le-admm-u",
    "mmcn",
    "updn",
    "flatnet",
    "svdeconv",
    "ifin",
]
METHODS += ["universal", "universal-small", "solver:admm", "solver:pyramid"]
RECORD = Path(__file__).parent / "results" / "costs.json"
HEAD = "| method | learned numbers | convolutions / GFLOP | transforms / GFLOP | memory / MB | seconds | of MWDN's |"


def numbers(method, size):
    """Learned numbers and operations of a network; nothing for others."""
    if method not in NETWORKS:
        return {}
    learned = sum(parameter.numel() for parameter in build(method).parameters())
    return {"learned": learned, **arithmetic.operations(method, size)}


def line(method, row, unit):
    """A row of the table."""
    counted = [f"{row[key]:.1f}" if key in row else "" for key in ("convolutions", "transforms")]
    memory = "" if row["mb"] is None else f"{row['mb']:.0f}"
    cells = [method.removeprefix(engine.SOLVER_PREFIX), f"{row['learned']:,}" if "learned" in row else "", *counted]
    return "| " + " | ".join([*cells, memory, f"{row['seconds']:.2f}", f"{row['seconds'] / unit:.2f}"]) + " |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="320x320")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    size = tuple(map(int, arguments.size.split("x")))
    calibration, picture = engine.problem(size, 1)
    contender = {method: "fast" if method.startswith(engine.SOLVER_PREFIX) else "exact" for method in arguments.methods}
    runs = {method: engine.contenders(method, calibration, "cpu", (name,))[name] for method, name in contender.items()}
    seconds = engine.seconds(runs, picture, arguments.repeats, time.process_time)
    record = {}
    for method, name in contender.items():
        mb = engine.peak_mb(method, size, name, "cpu")
        record[method] = {"seconds": seconds[method], "mb": mb, **numbers(method, size)}
    RECORD.write_text(json.dumps({"size": size, "methods": record}, indent=1) + "\n")
    unit = seconds.get("mwdn", min(seconds.values()))
    print(HEAD + "\n" + "| --- " * 7 + "|")
    for method, row in record.items():
        print(line(method, row, unit))


if __name__ == "__main__":
    main()
