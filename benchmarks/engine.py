"""Time and memory of every method, bound to a camera by `Reconstructor`, against the plain path in the same run.

    python benchmarks/engine.py [--sizes 320x320 270x480] [--threads 1 2] [--methods mwdn ...] [--batches 1 4]

Plain is the network as it is written: float32, contiguous tensors, nothing kept from call to call, the Wiener filter
as eq. (2) says, each step over the whole array. All contenders take turns, round after round, so that other work on
the machine meets all of them; the shortest time of each counts. ``exact`` is the engine in float32. Solvers are plain
functions and stand there for comparison; `benchmarks/admm.py` has their textbook.

Memory is the largest of a process of its own that reconstructs one capture, less that of the bare package; the engine's
weights and what it keeps of the PSF are counted, the files of torch are not.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import torch

from mwdn import Calibration, Reconstructor
from mwdn.fourier import extend, inverse_spectrum, spectrum
from mwdn.networks import NETWORKS, blocks, build
from mwdn.optics.patterns import contour_psf
from mwdn.solvers import SOLVERS

SOLVER_PREFIX = "solver:"
METHODS = [*NETWORKS, *(SOLVER_PREFIX + name for name in SOLVERS)]


def plain_filter(features, transfer, grid, boundary):
    """Transform, multiply, transform back, each for the whole array."""
    spread = spectrum(extend(features.float(), grid, boundary), grid)
    return inverse_spectrum(transfer * spread, grid, features.shape[-2:])


def problem(size, batch):
    generator = torch.Generator().manual_seed(0)
    psf = contour_psf(size, generator=generator).repeat(1, 3, 1, 1)
    return Calibration(psf / psf.sum((-2, -1), keepdim=True)), torch.rand(batch, 3, *size, generator=generator)


def contenders(method, calibration):
    """Functions of a batch by their names; plain first."""
    if method.startswith(SOLVER_PREFIX):
        return {"fast": Reconstructor(method.removeprefix(SOLVER_PREFIX), calibration, device="cpu")}
    torch.manual_seed(0)
    network = build(method).eval()

    @torch.inference_mode()
    def plain(batch):
        with mock.patch.object(blocks, "filtered", plain_filter):
            return network(batch, calibration.psf)

    return {
        "plain": plain,
        "exact": Reconstructor(network, calibration, device="cpu", precision="exact"),
        "fast": Reconstructor(network, calibration, device="cpu"),
    }


def seconds(runs, batch, repeats, clock):
    """Shortest time a picture of each."""
    best = dict.fromkeys(runs, float("inf"))
    for repeat in range(repeats + 1):
        for name, run in runs.items():
            start = clock()
            run(batch)
            if repeat:  # the first round warms up
                best[name] = min(best[name], (clock() - start) / len(batch))
    return best


def peak_mb(method, size, contender):
    """Largest memory of a fresh process that reconstructs twice, above that of one with the imports alone."""
    code = "import sys; sys.path.insert(0, 'benchmarks'); import engine; engine.child(*sys.argv[1:])"
    call = [sys.executable, "-c", code, method, *map(str, size), contender]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    return float(done.stdout) if done.returncode == 0 else None


def child(method, height, width, contender):
    """Print the memory, in MB."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    calibration, batch = problem((int(height), int(width)), 1)
    for _ in range(2):
        contenders(method, calibration)[contender](batch)
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=["320x320", "270x480"], help="3000x4000 is 12 megapixels")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 4])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cpu-time", action="store_true", help="count the process's own time: for a machine in use")
    parser.add_argument("--memory", action="store_true", help="measure memory too")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/engine.json"))
    arguments = parser.parse_args()
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    rows = []
    print("| method | size | threads | batch | plain / s | exact / s | | fast / s | | memory / MB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for text in arguments.sizes:
        size = tuple(int(length) for length in text.split("x"))
        for method in arguments.methods:
            memory = peak_mb(method, size, "fast") if arguments.memory else None
            calibration, batch = problem(size, max(arguments.batches))
            runs = contenders(method, calibration)
            for threads in arguments.threads:
                torch.set_num_threads(threads)
                for count in arguments.batches:
                    times = seconds(runs, batch[:count], arguments.repeats, clock)
                    row = {"method": method, "size": text, "threads": threads, "batch": count}
                    row["clock"] = "cpu" if arguments.cpu_time else "wall"
                    row |= {f"{name}_s": value for name, value in times.items()}
                    plain = times.get("plain")
                    row |= {f"{name}_ratio": plain / times[name] for name in ("exact", "fast") if plain}
                    rows.append(row | {"peak_mb": memory})
                    print(line(rows[-1]), flush=True)
            del runs
    write(arguments.out, rows)


def line(row):
    """A row of the table."""
    cells = [row["method"].removeprefix(SOLVER_PREFIX), row["size"], row["threads"], row["batch"]]
    for key in ("plain_s", "exact_s", "exact_ratio", "fast_s", "fast_ratio"):
        cells.append("" if key not in row else f"{row[key]:.3f}" if key.endswith("_s") else f"{row[key]:.2f} x")
    cells.append("" if row["peak_mb"] is None else f"{row['peak_mb']:.0f}")
    return f"| {' | '.join(map(str, cells))} |"


def write(path, rows):
    """JSON, and the table beside it; what another call measured of other methods or sizes stays."""
    key = lambda row: (row["size"], row["method"], row["threads"], row["batch"])  # noqa: E731
    known = json.loads(path.read_text())["rows"] if path.exists() else []
    kept = {key(row): row for row in [*known, *rows]}
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"torch": torch.__version__, "cpu": torch.backends.cpu.get_cpu_capability(), "rows": list(kept.values())}
    path.write_text(json.dumps(content, indent=2) + "\n")
    head = "| method | size | threads | batch | plain / s | exact / s | | fast / s | | memory / MB |\n"
    head += "| --- " * 10 + "|\n"
    path.with_suffix(".md").write_text(head + "\n".join(map(line, kept.values())) + "\n")


if __name__ == "__main__":
    main()
