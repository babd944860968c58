"""Effect of keeping freed memory in the process (`mwdn.keep_memory`), at one size.

    python benchmarks/memory.py [--size 1080x1920] [--methods universal ...] [--threads 2]

Each method reconstructs twice in a separate process, with and without; the second time counts: wall clock, the kernel's
share of processor time, and the peak memory of the process. Writes `benchmarks/results/memory.json`; rows of earlier
calls for other methods and sizes stay in it.
"""

import argparse
import json
import resource
import time
from pathlib import Path

import torch

import engine
from mwdn import keep_memory

METHODS = ["mwdn", "universal-small", "solver:pyramid"]


def child(method, height, width, threads, kept):
    """Measure in this process, and print the numbers."""
    if kept == "kept":
        assert keep_memory()
    torch.set_num_threads(int(threads))
    calibration, batch = engine.problem((int(height), int(width)), 1)
    reconstruct = engine.contenders(method, calibration, "cpu", ("fast",))["fast"]
    reconstruct(batch)
    before, start = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    reconstruct(batch)
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps([seconds, after.ru_stime - before.ru_stime, engine.highest_mb()]))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1080x1920")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/memory.json"))
    arguments = parser.parse_args()
    rows = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for method in arguments.methods:
        row = {"method": method, "size": arguments.size, "threads": arguments.threads}
        for kept in ("usual", "kept"):
            done = engine.alone("memory", method, *arguments.size.split("x"), arguments.threads, kept)
            done.check_returncode()
            seconds, kernel, mb = json.loads(done.stdout)
            row |= {f"{kept}_s": seconds, f"{kept}_kernel_s": kernel, f"{kept}_mb": mb}
        row["ratio"] = row["usual_s"] / row["kept_s"]
        print(*(f"{value:.4g}" if isinstance(value, float) else value for value in row.values()), flush=True)
        rows = [old for old in rows if any(old[key] != row[key] for key in ("method", "size", "threads"))] + [row]
    arguments.out.write_text(json.dumps({"torch": torch.__version__, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
