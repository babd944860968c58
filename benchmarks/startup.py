"""Time to start: `mwdn --version`, `mwdn --help` and `import mwdn` against `import torch` in the same run.

    python benchmarks/startup.py [--rounds 5]

Each runs in a fresh process, in turn, once to warm the disk's cache and then `--rounds` times; the fastest counts: on a
machine shared with others it has waited least. Prints seconds and parts of `import torch`.
"""

import argparse
import subprocess
import sys
import time

LINES = {
    "import torch": ["-c", "import torch"],
    "import cyclopts, rich": ["-c", "import cyclopts, rich"],
    "import mwdn": ["-c", "import mwdn"],
    "mwdn --version": ["-m", "mwdn", "--version"],
    "mwdn --help": ["-m", "mwdn", "--help"],
    "mwdn reconstruct --help": ["-m", "mwdn", "reconstruct", "--help"],
}


def seconds(line):
    """Wall time of one process."""
    start = time.perf_counter()
    subprocess.run([sys.executable, *line], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    times = [{name: seconds(line) for name, line in LINES.items()} for _ in range(rounds + 1)]
    best = {name: min(row[name] for row in times[1:]) for name in LINES}
    for name, value in best.items():
        print(f"{name:24} {value:6.3f} s {value / best['import torch']:6.2f}")


if __name__ == "__main__":
    main()
