"""Counts of all fuzz tests in one process: ``python tests/fuzz/count.py [--seed 31] [--part 1]``.

About 9,000 damaged files for ``--part 1``; kind of file, number, outcomes and the longest processor time of each.
"""

import argparse
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import pictures
import test_fuzz_checkpoints as checkpoints
import test_fuzz_pairs as pairs
import test_fuzz_recipes as recipes
import test_records as records
from driver import damaged, sweep

from mwdn.training.recipe import read_recipe
from mwdn.weights import load_checkpoint

Kind = tuple[str, Iterator[bytes], Callable[[Path], object], str, int]


def kinds(seed: int, folder: Path) -> Iterator[Kind]:
    """Name of each kind, its damaged contents, its reader, its file, and how many are tried."""
    for name in pictures.FILES:
        yield name, pictures.cases(name, seed=seed), pictures.read, name, 120
    for name, (make, read) in pairs.FORMATS.items():
        yield name, pairs.contents(make(), seed, None), read, "a.h5", 300
    for suffix in (".safetensors", ".pt"):
        contents = (content for kind, content in checkpoints.damaged(seed) if kind == suffix)
        yield f"checkpoint {suffix}", contents, load_checkpoint, f"a{suffix}", 500
    yield "recipe", recipes.cases(seed), read_recipe, "a.toml", 3000
    for name, content in records.FILES.items():
        for other, whole in records.FILES.items() | {("admm-captures.npy", records.PICTURES)}:
            (folder / other).write_bytes(whole)
        random = np.random.default_rng([seed, *name.encode()])
        yield f"benchmark {name}", (damaged(content, random) for _ in iter(int, 1)), records.read, name, 150


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--part", type=float, default=1.0, help="of the numbers of files")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        for name, contents, read, file, count in kinds(arguments.seed, Path(scratch)):
            times = [0.0]

            def timed(path: Path, read: Callable[[Path], object] = read, times: list[float] = times) -> None:
                start = time.process_time()
                try:
                    read(path)
                finally:
                    times.append(time.process_time() - start)

            wanted = max(1, round(arguments.part * count))
            outcomes = sweep(islice(contents, wanted), timed, Path(scratch) / file, named=name != "recipe")
            total.update({result.partition(":")[0]: number for result, number in outcomes.items()})
            print(f"{name:24} {dict(outcomes)}, slowest {max(times):.2f} s", flush=True)
    print(f"total {sum(total.values()):,}: {dict(total)}")


if __name__ == "__main__":
    main()
