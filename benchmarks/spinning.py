"""How long OpenMP's threads should spin before they sleep: alone on the machine, and beside a busy program.

    python benchmarks/spinning.py [--rounds 4] [--psf ../shared/data/mwdn-camera/psf_320.png]

`universal-small` and `pyramid` at 320 x 320, two threads, in fresh processes that take turns, one for each value of
GOMP_SPINCOUNT; the shortest time of each counts. Then the same beside a program that takes a core: the mean time. The
machine must have two cores and be idle otherwise.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import mean

import torch

from mwdn import Calibration, Reconstructor, keep_memory

SPINS = 300_000, 10_000, 1_000
"""GNU OpenMP's default, one between, and what the command line sets."""
METHODS = {"universal-small": 16, "pyramid": 3}
"""Calls of each in a process."""


def measure(psf):
    """Print the times of each method in seconds, as JSON."""
    torch.set_num_threads(2)
    keep_memory()
    calibration = Calibration.from_file(psf)
    measurement = torch.rand(1, 3, 320, 320, generator=torch.Generator().manual_seed(0))
    times = {}
    for method, calls in METHODS.items():
        reconstruct, times[method] = Reconstructor(method, calibration), []
        reconstruct(measurement)
        for _ in range(calls):
            start = time.perf_counter()
            reconstruct(measurement)
            times[method].append(time.perf_counter() - start)
    print(json.dumps(times))


def measured(psf, spins):
    """The same in a process of its own."""
    line = [sys.executable, __file__, "--measure", "--psf", str(psf)]
    environment = os.environ | {"GOMP_SPINCOUNT": str(spins)}
    return json.loads(subprocess.run(line, check=True, env=environment, stdout=subprocess.PIPE).stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--psf", type=Path, default=Path("../shared/data/mwdn-camera/psf_320.png"))
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        measure(arguments.psf)
        return
    rows = [{spins: measured(arguments.psf, spins) for spins in SPINS} for _ in range(arguments.rounds)]
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        beside = {spins: measured(arguments.psf, spins) for spins in SPINS}
    finally:
        busy.kill()
    for method in METHODS:
        print(f"{method}, ms: GOMP_SPINCOUNT, alone, beside a busy program")
        for spins in SPINS:
            alone = min(min(row[spins][method]) for row in rows)
            print(f"{spins:8,} {alone * 1000:8.1f} {mean(beside[spins][method]) * 1000:8.0f}")


if __name__ == "__main__":
    main()
