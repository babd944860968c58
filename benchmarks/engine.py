"""Time and memory of every method prepared by `Reconstructor`, against the plain network in the same run.

    python benchmarks/engine.py [--sizes 320x320 270x480] [--threads 1 2] [--methods mwdn ...] [--batches 1 4]

*Plain* is the network as written: float32, contiguous tensors, nothing kept between calls, the Wiener filter as eq.
(2), each step over the whole array. *exact* is the engine in float32, *fast* its default. Solvers are listed for
comparison; `benchmarks/admm.py` has their textbook version. All contenders take turns, so that other work on the
machine affects all of them; the shortest time of each counts. If there is a GPU, everything is measured on it too.

Skipped: calls of more than ``--longest`` seconds, estimated from the next smaller size and the number of pixels;
batches of more than 4 megapixels (64 on a GPU); on a CPU above 4 megapixels everything but the fast path, because the
others need tens of gigabytes. A call of more than 10 seconds is made once; any other once to warm up and ``--repeats``
times.

Memory is the peak of a separate process that reconstructs one capture, minus that of the imported package. It includes
weights and what is kept of the PSF, not the files of torch. On a GPU it is what torch reserved there.

A second table shows where the time goes (`benchmarks/arithmetic.py`). Rows of earlier calls for other methods, sizes or
threads stay in the files.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import torch

import arithmetic
from mwdn import Calibration, Reconstructor
from mwdn.fourier.filtering import reference_filter
from mwdn.inference.methods import find_method
from mwdn.networks import NETWORKS, build, wiener_filter
from mwdn.optics import sample_camera
from mwdn.solvers import SOLVERS
from mwdn.weights.bundled import BUNDLED

SOLVER_PREFIX = "solver:"
METHODS = [*NETWORKS, *BUNDLED, *(SOLVER_PREFIX + name for name in SOLVERS)]
USUAL = ["mwdn", "mwdn-cpsf", "unet", "wiener-unet", "le-admm", *BUNDLED, *METHODS[-len(SOLVERS) :]]
SIZES = ["320x320", "270x480", "1080x1920", "3000x4000"]
CONTENDERS = ("plain", "exact", "fast")
MEGA = 10**6
HEAD = (
    "| method | size | device | threads | batch | plain / s | exact / s | | fast / s | | plain / MB | fast / MB |\n"
    + "| --- " * 12
    + "|"
)


def problem(size, batch):
    generator = torch.Generator().manual_seed(0)
    return Calibration(sample_camera(generator, size, family="contours")), torch.rand(
        batch, 3, *size, generator=generator
    )


def contenders(method, calibration, device, names=CONTENDERS):
    """Functions of a batch by name; plain first."""
    if method.startswith(SOLVER_PREFIX):
        return {"fast": Reconstructor(method.removeprefix(SOLVER_PREFIX), calibration, device=device)}
    torch.manual_seed(0)
    network = (find_method(method) if method in BUNDLED else build(method)).eval()
    runs = {
        name: Reconstructor(network, calibration, device=device, precision=name) for name in names if name != "plain"
    }
    if "plain" not in names:
        return runs
    network, psf = network.to(device), calibration.psf.to(device)

    @torch.inference_mode()
    def plain(batch):
        whole = mock.patch.object(wiener_filter.WienerFilter, "max_grid_pixels", 2**60)
        with mock.patch.object(wiener_filter, "filter_image", reference_filter), whole:
            return network(batch.to(device), psf).cpu()

    return {"plain": plain, **runs}


def seconds(runs, batch, repeats, clock):
    """Shortest time per picture of each."""
    best, slow = {}, set()
    for repeat in range(repeats + 1):
        for name in [name for name in runs if name not in slow]:
            start = clock()
            runs[name](batch)
            spent = clock() - start
            if spent > 10:
                slow.add(name)
            if repeat or name in slow:  # otherwise the first round warms up
                best[name] = min(best.get(name, float("inf")), spent / len(batch))
    return best


def peak_mb(method, size, contender, device):
    """Peak memory of a new process that reconstructs, minus that after the imports."""
    done = alone("engine", method, *size, contender, device)
    return float(done.stdout) if done.returncode == 0 else None


def alone(benchmark, *arguments):
    """Run `child` of a benchmark in a separate process."""
    code = f"import sys; sys.path.insert(0, 'benchmarks'); import {benchmark}; {benchmark}.child(*sys.argv[1:])"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False
    )


def child(method, height, width, contender, device):
    """Print the memory in MB."""
    before = highest_mb()
    calibration, batch = problem((int(height), int(width)), 1)
    contenders(method, calibration, device, (contender,))[contender](batch)
    print(torch.cuda.max_memory_reserved() / 2**20 if device == "cuda" else highest_mb() - before)


def highest_mb():
    """Peak memory of this process in MB; getrusage would start from its parent's."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


class Measurement:
    """Measures the methods, size by size."""

    def __init__(self, arguments):
        self.arguments, self.rates = arguments, {}
        self.clock = time.process_time if arguments.cpu_time else time.perf_counter

    def of(self, method, size, device):
        """Rows of one method at one size, for each number of threads and batch size."""
        pixels, names = size[0] * size[1], CONTENDERS
        if device == "cpu" and pixels > 4 * MEGA:
            names = ("fast",)
        if method.startswith(SOLVER_PREFIX):
            names = ("fast",)
        names = [name for name in names if self.seconds_of(name, method, device, pixels) <= self.arguments.longest]
        memory = {name: peak_mb(method, size, name, device) for name in names if self.arguments.memory}
        most = (64 if device == "cuda" else 4) * MEGA
        batches = [count for count in self.arguments.batches if count == 1 or count * pixels <= most]
        calibration, batch = problem(size, max(batches))
        runs = contenders(method, calibration, device, names) if names else {}
        for threads in self.arguments.threads if device == "cpu" else [torch.get_num_threads()]:
            torch.set_num_threads(threads)
            for count in batches:
                known = self.seconds_of
                own = {
                    name: run
                    for name, run in runs.items()
                    if known(name, method, device, count * pixels, threads) <= self.arguments.longest
                }
                times = seconds(own, batch[:count], self.arguments.repeats, self.clock)
                for name, value in times.items():
                    self.rates[name, method, device, threads] = value / pixels
                if times:
                    row = {"method": method, "size": "{}x{}".format(*size), "device": device, "threads": threads}
                    row |= {"batch": count, "clock": "cpu" if self.arguments.cpu_time else "wall"}
                    yield row | ratios(times) | {f"{name}_mb": value for name, value in memory.items()}

    def seconds_of(self, name, method, device, pixels, threads=None):
        """Expected time of a call from the measured rates; the shortest over all thread counts by default."""
        known = [
            rate
            for (*key, count), rate in self.rates.items()
            if key == [name, method, device] and threads in (None, count)
        ]
        return pixels * min(known, default=0)


def ratios(times):
    plain = times.get("plain")
    row = {f"{name}_s": value for name, value in times.items()}
    return row | {f"{name}_ratio": plain / times[name] for name in ("exact", "fast") if plain and name in times}


def line(row):
    """A row of the table."""
    cells = [row["method"].removeprefix(SOLVER_PREFIX), row["size"], row["device"], row["threads"], row["batch"]]
    for key in ("plain_s", "exact_s", "exact_ratio", "fast_s", "fast_ratio"):
        cells.append("" if key not in row else f"{row[key]:.3f}" if key.endswith("_s") else f"{row[key]:.2f} x")
    cells += ["" if row.get(key) is None else f"{row[key]:.0f}" for key in ("plain_mb", "fast_mb")]
    return f"| {' | '.join(map(str, cells))} |"


def write(path, measured, profiled):
    """Write the JSON, and the tables beside it."""
    known = json.loads(path.read_text()) if path.exists() else {}
    keys = ("size", "method", "device", "threads", "batch", "precision", "part")
    content = {"torch": torch.__version__, "cpu": torch.backends.cpu.get_cpu_capability()}
    if torch.cuda.is_available():
        content["gpu"] = torch.cuda.get_device_name()
    for name, rows in (("rows", measured), ("profile", profiled)):
        every = [{"device": "cpu", **row} for row in known.get(name, [])] + rows
        content[name] = list({tuple(row.get(key) for key in keys): row for row in every}.values())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
    parts = [HEAD, *map(line, content["rows"]), "", arithmetic.HEAD, "| --- " * 11 + "|"]
    path.with_suffix(".md").write_text("\n".join([*parts, *map(arithmetic.line, content["profile"])]) + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="heights and widths; 3000x4000 is 12 megapixels")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--methods", nargs="+", default=USUAL, choices=METHODS)
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 4], help="add 16 64 on a GPU")
    parser.add_argument("--devices", nargs="+", default=["cpu", *(["cuda"] if torch.cuda.is_available() else [])])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--longest", type=float, default=120, help="skip calls of more than so many seconds")
    parser.add_argument("--cpu-time", action="store_true", help="measure the process's own time, on a shared machine")
    parser.add_argument("--memory", action="store_true", help="measure memory too")
    parser.add_argument("--profile", nargs="*", default=["320x320", "1080x1920"], help="sizes of the second table")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/engine.json"))
    arguments = parser.parse_args()
    measurement, sizes = Measurement(arguments), {text: tuple(map(int, text.split("x"))) for text in arguments.sizes}
    print(HEAD)
    for device in arguments.devices:
        for size in sorted(sizes.values(), key=lambda size: size[0] * size[1]):
            for method in arguments.methods:
                for row in measurement.of(method, size, device):
                    print(line(row), flush=True)
                    write(arguments.out, [row], [])
    print(f"\n{arithmetic.HEAD}\n{'| --- ' * 11}|")
    for device in arguments.devices:
        torch.set_num_threads(max(arguments.threads))
        for size in (tuple(map(int, text.split("x"))) for text in arguments.profile):
            calibration, picture = problem(size, 1)
            for method in (method for method in arithmetic.METHODS if method in arguments.methods):
                for precision in ("exact", "fast"):
                    rows = list(arithmetic.rows(method, size, calibration.psf.to(device), picture, precision))
                    print(*map(arithmetic.line, rows), sep="\n", flush=True)
                    write(arguments.out, [], rows)


if __name__ == "__main__":
    main()
