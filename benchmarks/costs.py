"""Operations, memory and time of every method for one picture, beside each other.

    python benchmarks/costs.py [--size 320x320] [--repeats 2] [--methods mwdn updn ...]
    python benchmarks/costs.py --device cuda --repeats 20

Networks are at their published width, with random weights, prepared for one camera; float32, one thread. Time is
processor time, the shortest of ``--repeats`` rounds in which all methods take turns, after one to warm up: on a busy
machine the ratios hold, not the seconds. GFLOP are those of convolutions and Fourier transforms. Memory is the peak
of a process that reconstructs one picture, less that after the imports. Writes `benchmarks/results/costs.json`.

On a GPU the time is that of the clock on the wall, from a measurement on the GPU to the scene there, with all work
done; the shortest of up to ``--repeats`` calls, method by method. Beside float32 (*exact*) it is measured for the
engine's half precision (*fast*), and for the network as written, called with the PSF each time (*plain*): without a
CUDA graph, in TF32, its scene copied to the host, `universal` without alignment. Writes
`benchmarks/results/costs-gpu.json`.
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
RESULTS = Path(__file__).parent / "results"
RECORDS = {"cpu": "costs.json", "cuda": "costs-gpu.json"}
LONGEST = 3.0
"""Seconds for the calls of one method on a GPU."""

GPU_HEAD = "| method | exact / ms | of MWDN's | fast / ms | of MWDN's | plain / ms | of MWDN's |"
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


def on_cpu(size, methods, repeats, out):
    """Measure, print and record everything, with one thread."""
    torch.set_num_threads(1)
    calibration, picture = engine.problem(size, 1)
    contender = {method: "fast" if method.startswith(engine.SOLVER_PREFIX) else "exact" for method in methods}
    runs = {method: engine.contenders(method, calibration, "cpu", (name,))[name] for method, name in contender.items()}
    seconds = engine.seconds(runs, picture, repeats, time.process_time)
    record = {}
    for method, name in contender.items():
        mb = engine.peak_mb(method, size, name, "cpu")
        record[method] = {"seconds": seconds[method], "mb": mb, **numbers(method, size)}
    out.write_text(json.dumps({"size": size, "methods": record}, indent=1) + "\n")
    unit = seconds.get("mwdn", min(seconds.values()))
    print(HEAD + "\n" + "| --- " * 7 + "|")
    for method, row in record.items():
        print(line(method, row, unit))


def on_gpu(size, methods, repeats, out):
    """Measure and record the times method by method, then print the table."""
    calibration, picture = engine.problem(size, 1)
    picture = picture.to("cuda")
    record = {"size": size, "device": torch.cuda.get_device_name(), "torch": torch.__version__, "methods": {}}
    for method in methods:
        runs = engine.contenders(method, calibration, "cuda")
        if method.startswith(engine.SOLVER_PREFIX):
            runs = {"exact": runs["fast"]}  # solvers are always exact
        runs = {name: run if name == "plain" else synchronised(run) for name, run in runs.items()}
        first = engine.seconds(runs, picture, 2, time.perf_counter)  # computes, records the CUDA graph, replays it
        count = max(1, min(repeats, int(LONGEST / sum(first.values()))))
        seconds = engine.seconds(runs, picture, count, time.perf_counter)
        record["methods"][method] = seconds
        print(method, *(f"{name} {1e3 * value:.2f} ms" for name, value in seconds.items()), flush=True)
        out.write_text(json.dumps(record, indent=1) + "\n")
    print(f"\n{GPU_HEAD}\n{'| --- ' * 7}|")
    for method, seconds in record["methods"].items():
        print(gpu_line(method, seconds, record["methods"].get("mwdn", {})))


def synchronised(reconstruct):
    """A function of a measurement on the GPU that returns when the scene is there."""

    def call(measurement):
        reconstruct.on_device(measurement)
        torch.cuda.synchronize()

    return call


def gpu_line(method, seconds, units):
    """A row of the table."""
    cells = [method.removeprefix(engine.SOLVER_PREFIX)]
    for name in ("exact", "fast", "plain"):
        cells.append(f"{1e3 * seconds[name]:.2f}" if name in seconds else "")
        cells.append(f"{seconds[name] / units[name]:.2f}" if name in seconds and name in units else "")
    return f"| {' | '.join(cells)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="320x320")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--device", default="cpu", choices=RECORDS)
    parser.add_argument("--out", type=Path, help="the record; beside the others unless given")
    arguments = parser.parse_args()
    size, out = tuple(map(int, arguments.size.split("x"))), arguments.out or RESULTS / RECORDS[arguments.device]
    measure = on_gpu if arguments.device == "cuda" else on_cpu
    measure(size, arguments.methods, arguments.repeats, out)


if __name__ == "__main__":
    main()
