"""Exported files against the reconstructor: agreement, size, time.

    python benchmarks/export.py --psf PSF [--captures FILE ...] [--methods universal-small] [--kinds .onnx:int8]

Agreement is the PSNR against the exact reconstruction, with its brightest pixel as peak, of the worst capture: of the
simulated ones that verify an export, and of real ones if given. All contenders take turns, and the shortest time of
each counts. On a shared machine, `--cpu-time` with one thread measures the process's own time.

    python benchmarks/export.py --transforms

compares ways to transform a plane forward and back in onnxruntime: its own operation, and matrix products.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import torch

from mwdn import Calibration, Reconstructor
from mwdn.data.captures import find_captures, read_captures
from mwdn.export.exporter import agreement, export
from mwdn.export.onnx_graph import OnnxGraph
from mwdn.export.onnx_program import to_onnx
from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.fourier.wiener import deconvolution_grid

KINDS = [(".onnx", "float32"), (".onnx", "float16"), (".onnx", "int8"), (".pt2", "float32"), (".pt2", "float16")]


def opened(file, threads):
    """Load an exported file as a function of a measurement."""
    if file.suffix == ".pt2":
        module = torch.export.load(file).module()
        return torch.no_grad()(lambda measurement: module(measurement))
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    return lambda measurement: torch.from_numpy(session.run(None, {"measurement": measurement.numpy()})[0])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--transforms", action="store_true", help="compare ways to transform")
    parser.add_argument("--psf", type=Path)
    parser.add_argument("--captures", type=Path, nargs="*", default=[], help="real ones, of the PSF's size")
    parser.add_argument("--methods", nargs="+", default=["universal-small"])
    parser.add_argument("--kinds", nargs="+", default=KINDS, type=lambda text: tuple(text.split(":")))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cpu-time", action="store_true", help="measure the process's own time, on a shared machine")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/export.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    if arguments.transforms:
        transforms(arguments, clock)
    else:
        files(arguments, clock)


def files(arguments, clock):
    """Print a table and write a JSON: one row per file, and two of the reconstructor."""
    calibration = Calibration.from_file(arguments.psf)
    captures = read_captures(find_captures(arguments.captures), calibration) if arguments.captures else None
    rows = []
    print("| method | file | convolutions | MB | agreement / dB | on real captures / dB | export / s | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for method in arguments.methods:
        for row in measured(method, calibration, captures, arguments, clock):
            rows.append(row)
            print(line(row), flush=True)
    kept = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    rows = [row for row in kept if row["method"] not in arguments.methods] + rows
    content = {"torch": torch.__version__, "cpu": torch.backends.cpu.get_cpu_capability(), "threads": arguments.threads}
    content |= {"clock": "cpu" if arguments.cpu_time else "wall", "size": list(calibration.size), "rows": rows}
    arguments.out.write_text(json.dumps(content, indent=2) + "\n")


def measured(method, calibration, captures, arguments, clock):
    """Rows of one method."""
    rows, runs = [], {}
    with tempfile.TemporaryDirectory() as folder:
        for suffix, precision in arguments.kinds:
            start = clock()
            file = Path(folder) / f"{precision}{suffix}"
            done = export(method, calibration, file, precision=precision)
            row = {"method": method, "file": suffix, "precision": precision, "mb": file.stat().st_size / 1e6}
            rows.append(row | {"agreement_db": finite(done.agreement), "export_s": clock() - start})
            runs[suffix, precision] = opened(file, arguments.threads)
        for precision in ("exact", "fast"):
            rows.append({"method": method, "file": "mwdn", "precision": precision})
            # Neither aligned nor without the light of the room, as in the files.
            same = {"align": False, "room_light": False, "device": "cpu"}
            runs["mwdn", precision] = Reconstructor(method, calibration, **same, precision=precision)
        batch = torch.rand(1, 3, *calibration.size) if captures is None else captures[:1]
        best = shortest(runs, batch, arguments.repeats, clock)
        for row in rows:
            key = row["file"], row["precision"]
            row["s"] = best[key]
            if captures is not None:
                row["captures_db"] = finite(agreement(runs[key](captures), runs["mwdn", "exact"](captures)))
    return rows


def shortest(runs, batch, repeats, clock):
    """Shortest time of each in seconds, taking turns."""
    best = dict.fromkeys(runs, float("inf"))
    for repeat in range(repeats + 1):
        for name, run in runs.items():
            start = clock()
            run(batch)
            if repeat:  # the first round warms up
                best[name] = min(best[name], clock() - start)
    return best


class ThereAndBack(torch.nn.Module):
    """Transform a zero-padded plane forward and back."""

    def __init__(self, size):
        super().__init__()
        self.size, self.grid = size, deconvolution_grid(size, "zero")

    def forward(self, measurement):
        return inverse_spectrum(spectrum(measurement, self.grid), self.grid, self.size)


def operation(size, grid, channels):
    """The same with ONNX's own `DFT`, one axis at a time."""
    g = OnnxGraph()
    whole = g("Pad", "measurement", g.integers([0] * 6 + [grid[0] - size[0], grid[1] - size[1]]))
    planes = g("Unsqueeze", whole, g.integers([4]))
    for axis, options in ((3, {}), (2, {}), (2, {"inverse": 1}), (3, {"inverse": 1})):
        planes = g("DFT", planes, None, axis=axis, **options)
    planes = g("Slice", planes, g.integers([0, 0, 0]), g.integers([*size, 1]), g.integers([2, 3, 4]))
    shape = [1, channels, *size]
    return g.model({"measurement": shape}, {"scene": (g("Squeeze", planes, g.integers([4])), shape)})


def transforms(arguments, clock):
    """Print a table: milliseconds per plane, and the largest error."""
    import onnx

    channels = 8
    print("| picture | grid | DFT / ms | error | products / ms | error | torch / ms |\n| --- " + "| --- " * 6 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for size in ((320, 320), (270, 480), (341, 341)):
            both = ThereAndBack(size)
            batch = torch.rand(1, channels, *size)
            models = operation(size, both.grid, channels), to_onnx(torch.export.export(both, (batch,)))
            runs = {"torch": torch.no_grad()(both)}
            for name, model in zip(("DFT", "products"), models, strict=True):
                onnx.save(model, f"{folder}/{name}.onnx")
                runs[name] = opened(Path(f"{folder}/{name}.onnx"), arguments.threads)
            best = shortest(runs, batch, arguments.repeats, clock)
            cells = [f"{a} x {b}" for a, b in (size, both.grid)]
            for name in ("DFT", "products"):
                cells += [f"{1e3 * best[name] / channels:.2f}", f"{(runs[name](batch) - batch).abs().max():.0e}"]
            print(f"| {' | '.join(cells)} | {1e3 * best['torch'] / channels:.2f} |", flush=True)


def finite(decibels):
    """Decibels for JSON; ``None`` if there is no difference."""
    return None if decibels == float("inf") else decibels


def line(row):
    """A row of the table."""
    numbers = [row.get("mb"), row.get("agreement_db"), row.get("captures_db"), row.get("export_s")]
    cells = ["" if value is None else f"{value:.1f}" for value in numbers]
    return f"| {row['method']} | {row['file']} | {row['precision']} | {' | '.join(cells)} | {row['s']:.3f} |"


if __name__ == "__main__":
    main()
