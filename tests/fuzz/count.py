"""All fuzz tests in one process, counted: kind of file, number, outcomes, longest processor time.

``python tests/fuzz/count.py [--seed 31] [--part 1]`` reads about 9,000 damaged files. ``--seconds 1800`` goes round all
kinds until the time is up, and prints the memory after each round. A crash leaves the file in ``--folder``; a case of
more than `HANG_S` ends the process with a traceback.
"""

import argparse
import faulthandler
import os
import resource
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import other_files
import pictures
import test_fuzz_checkpoints as checkpoints
import test_fuzz_pairs as pairs
import test_fuzz_recipes as recipes
import test_records as records
from driver import damaged, sweep
from other_files import UNNAMED, written

from mwdn.training.recipe import read_recipe
from mwdn.weights import load_checkpoint

HANG_S = 300


class Kind(NamedTuple):
    """Name, damaged contents without end, reader, file, how many are tried in a run with ``--part 1``."""

    name: str
    contents: Iterator[bytes]
    read: Callable[[Path], object]
    file: Path
    count: int


def endless(whole: bytes, *seed: int) -> Iterator[bytes]:
    random = np.random.default_rng(seed)
    while True:
        yield damaged(whole, random)


def kinds(seed: int, folder: Path) -> Iterator[Kind]:
    """Every kind, each with a folder of its own."""
    for name in pictures.FILES:
        yield Kind(name, pictures.cases(name, seed=seed), pictures.read, folder / name, 120)
    for name, (make, read) in pairs.FORMATS.items():
        yield Kind(name, pairs.contents(make(), seed, None), read, folder / "a.h5", 300)
    for suffix in (".safetensors", ".pt"):
        contents = (content for kind, content in checkpoints.damaged(seed) if kind == suffix)
        yield Kind(f"checkpoint {suffix}", contents, load_checkpoint, folder / f"a{suffix}", 500)
    yield Kind("recipe", recipes.cases(seed), read_recipe, folder / "a.toml", 3000)
    for name, content in records.FILES.items():
        place = written(folder / f"record-{name}", records.FILES | {"admm-captures.npy": records.PICTURES})
        yield Kind(f"benchmark {name}", endless(content, seed, *name.encode()), records.read, place / name, 150)
    for name, kind in other_files.kinds().items():
        place = written(folder / name, kind.files)

        def read(path: Path, kind: other_files.Kind = kind) -> None:
            written(path.parent, {name: content for name, content in kind.files.items() if name != path.name})
            kind.read(path)

        yield Kind(name, endless(kind.files[kind.name], seed, *name.encode()), read, place / kind.name, 150)


class Tally:
    """Outcomes and the longest processor time of one kind."""

    def __init__(self, kind: Kind) -> None:
        self.kind, self.slowest = kind, 0.0
        self.outcomes: Counter[str] = Counter()

    def add(self, count: int) -> None:
        named = self.kind.name not in UNNAMED | {"recipe"}
        self.outcomes += sweep(islice(self.kind.contents, count), self._timed, self.kind.file, named=named)

    def _timed(self, path: Path) -> None:
        start = time.process_time()
        faulthandler.dump_traceback_later(HANG_S, exit=True)
        try:
            self.kind.read(path)
        finally:
            faulthandler.cancel_dump_traceback_later()
            self.slowest = max(self.slowest, time.process_time() - start)

    def __str__(self) -> str:
        return f"{self.kind.name:20} {self.outcomes.total():7,} {dict(self.outcomes)}, slowest {self.slowest:.2f} s"


def memory() -> str:
    """Memory of this process now, and at most until now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    now, most = pages * resource.getpagesize() / 2**20, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    return f"{now:.1f} MiB, at most {most:.0f} MiB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--part", type=float, default=1.0, help="of the numbers of files in a round")
    parser.add_argument("--seconds", type=float, default=0.0, help="at least, in whole rounds")
    parser.add_argument("--folder", type=Path, required=True, help="for the damaged files")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    faulthandler.enable()
    os.environ.setdefault("MWDN_DATA", "/nowhere")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    tallies = [Tally(kind) for kind in kinds(arguments.seed, arguments.folder)]
    start, rounds = time.monotonic(), 0
    while rounds == 0 or time.monotonic() - start < arguments.seconds:
        for tally in tallies:
            tally.add(max(1, round(arguments.part * tally.kind.count)))
        rounds += 1
        spent = f"{time.monotonic() - start:,.0f} s, {time.process_time():,.0f} s of processor"
        print(f"round {rounds}: {sum(t.outcomes.total() for t in tallies):,} files, {spent}, {memory()}", flush=True)
    print(*tallies, sep="\n")
    total: Counter[str] = Counter()
    for tally in tallies:
        total.update({result.partition(":")[0]: number for result, number in tally.outcomes.items()})
    print(f"total {total.total():,}: {dict(total)}")
    sys.exit(1 if total["wrong"] else os.EX_OK)


if __name__ == "__main__":
    main()
