"""Pictures of docs/claims.md: learning curves, PSNR against mismatch, and real captures, of one folder of a benchmark.

    mwdn benchmark benchmark-quarter --out runs/quarter --seed 3
    mwdn recipes benchmark-quarter |
        sed 's/bin = 4/&, deviation = { turn_degrees = 0, haze = 0, off_axis = 0 }/' > exact.toml
    mwdn benchmark exact.toml --out runs/exact --seed 3
    python docs/claims.py runs/quarter [--exact runs/exact] [--captures ../shared/data/mwdn-camera/real-objects]
                                       [--recipe benchmark-quarter] [--record FILE] [--out docs]

Mismatch is the deviation of the data set's true camera times 0, 1, 2 and 3: 0 is a camera that matches its
calibration, 1 the camera of the training. Also measured, at 1: cameras and methods with the mirrored PSF. The scenes
and the noise are the same for all. Networks of `--exact` were trained without mismatch; their labels end in ", exact".
Writes ``claims-curves.png``, ``claims-captures.jpg``, and the numbers to the record, from which finished methods are
not measured again.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from statistics import fmean

import cv2
import matplotlib
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch.nn import functional as F

from mwdn import Reconstructor, read_frame, to_display
from mwdn.benchmark.methods import MEAN
from mwdn.benchmark.recipe import Benchmark
from mwdn.benchmark.recipe_reader import read_benchmark
from mwdn.benchmark.scoring import make_reconstructor
from mwdn.benchmark.sets import Dataset, open_dataset, simulated_pairs
from mwdn.benchmark.training import curve
from mwdn.data.photographs import Photographs
from mwdn.evaluation import measure
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.files import file_sha256, write_text
from mwdn.io.images import srgb_encode
from mwdn.optics import Deviation
from mwdn.training.experiment import FILE_START
from mwdn.types import Measurement, Scene

matplotlib.use("agg")
RECORD = Path(__file__).resolve().parent.parent / "benchmarks" / "results" / "mismatch-quarter.json"
FACTORS = (0.0, 1.0, 2.0, 3.0)  # from 4 on, the corners of the field would get negative light
COUNT = 16  # test pictures for each factor
EXACT = ", exact"  # behind the name of a network that was trained without mismatch


def mirrored(dataset: Dataset) -> Dataset:
    """The data set with a PSF that no network here was trained for: its mirror image, of the same statistics."""
    psf = dataset.calibration.psf.flip(-1).roll(1, -1)  # the centre stays at width // 2
    return replace(dataset, calibration=replace(dataset.calibration, psf=psf))


def pairs(dataset: Dataset, photographs: Photographs, factor: float) -> tuple[Measurement, Scene]:
    """Test pairs through a camera with the data set's deviation times a factor."""
    deviation = Deviation(**{name: factor * value for name, value in asdict(dataset.recipe.deviation).items()})
    source = simulated_pairs(
        replace(dataset.recipe, deviation=deviation), dataset.calibration, photographs, torch.device("cpu")
    )
    batch = source.batch(range(FILE_START, FILE_START + COUNT))
    return batch.measurement, batch.scene


def reconstructors(benchmark: Benchmark, dataset: Dataset, weights: dict[str, Path]) -> dict[str, Reconstructor]:
    """The recipe's methods, without the networks that have no weights."""
    return {
        method.label: make_reconstructor(method, weights.get(method.label), dataset, "cpu")
        for method in benchmark.methods
        if method.name != MEAN and (not method.learned or method.label in weights)
    }


def finished(runs: Path, steps: int) -> dict[str, Path]:
    """Best weights of each network whose training is at its end."""
    done = [path for path in sorted(runs.iterdir()) if (path / "log.jsonl").exists()]
    return {path.name: path / "best.safetensors" for path in done if curve(path)[0][-1][0] == steps}


def renamed(benchmark: Benchmark, weights: dict[str, Path], suffix: str) -> tuple[Benchmark, dict[str, Path]]:
    """The networks that have weights, and these weights, with a suffix to each label."""
    methods = tuple(replace(m, label=m.label + suffix) for m in benchmark.methods if m.label in weights)
    return replace(benchmark, methods=methods), {label + suffix: path for label, path in weights.items()}


def score(method: Reconstructor, test: tuple[Measurement, Scene], dataset: Dataset) -> float:
    """Mean PSNR of the test pairs."""
    measurements, scenes = test
    pictures = torch.cat([method(each[None]) for each in measurements])
    return round(fmean(measure(pictures, scenes, dataset.protocol, variant="raw")["psnr"].tolist()), 2)


def mismatch(
    benchmark: Benchmark,
    dataset: Dataset,
    weights: dict[str, Path],
    methods: dict[str, Reconstructor],
    path: Path,
) -> dict[str, list[float]]:
    """PSNR of each method at each factor, and with the mirrored PSF; recorded results are kept."""
    hashes = {label: file_sha256(weights[label])[:16] if label in weights else "" for label in methods}
    settings = {"factors": list(FACTORS), "count": COUNT}
    record = json.loads(path.read_text()) if path.exists() else {}
    if {key: record.get(key) for key in settings} != settings:
        record = settings
    record = {"psnr": {}, "mirrored": {}, "weights": {}} | record
    known = record["mirrored"].keys() & {label for label in hashes if record["weights"].get(label) == hashes[label]}
    if missing := [label for label in methods if label not in known]:
        photographs, other = Photographs(dataset.recipe.test_photos), mirrored(dataset)
        tests = [pairs(dataset, photographs, factor) for factor in FACTORS]
        turned, others = pairs(other, photographs, 1.0), reconstructors(benchmark, other, weights)
    for label in missing:
        if record["weights"].get(label) != hashes[label]:
            record["psnr"][label] = [score(methods[label], test, dataset) for test in tests]
        record["mirrored"][label] = score(others[label], turned, dataset)
        record["weights"][label] = hashes[label]
        print(label, record["psnr"][label], record["mirrored"][label], flush=True)
        write_text(path, json.dumps(record, indent=1) + "\n")
    return record["psnr"]


Colours = Mapping[str, tuple[float, float, float]]


def draw_learning(axes: Axes, runs: Path, colours: Colours, batch: int) -> None:
    """PSNR of the validation over the number of samples."""
    for label, colour in colours.items():
        points = curve(runs / label)[1]
        axes.plot([step * batch for step, _ in points], [value for _, value in points], color=colour)
    axes.set(xlabel="samples", ylabel="validation, whole frame: PSNR / dB", title="Learning curves")


def draw_mismatch(axes: Axes, psnr: dict[str, list[float]], colours: Colours) -> None:
    """PSNR against the factor on the deviation."""
    for label, values in psnr.items():
        axes.plot(FACTORS, values, "o-", label=label, markersize=3, color=colours[label])
    axes.set(xlabel="mismatch, 1 is that of the training", ylabel="test, centre: PSNR / dB", title="Mismatch")


def draw_captures(methods: dict[str, Reconstructor], dataset: Dataset, folder: Path, out: Path) -> None:
    """Real captures, binned to the size of the training, by every method."""
    rows = []
    for path in sorted(folder.glob("object_*.png")):
        measurement = dataset.calibration.correct(read_frame(path))
        pictures = [to_display(method(measurement)) for method in methods.values()]
        top = (measurement.shape[-1] - 50) // 2  # the objects are in the central 50 x 50 of 80 x 80 pixels
        cut = [each[..., top : top + 50, top : top + 50] for each in pictures]
        rows.append([F.interpolate(each, scale_factor=3, mode="bicubic").clamp(0, 1) for each in cut])
    columns = list(zip(list(methods), *rows, strict=True))
    half = -(-len(columns) // 2)
    sheets = [
        contact_sheet([list(row) for row in zip(*(c[1:] for c in part), strict=True)], [c[0] for c in part], height=168)
        for part in (columns[:half], columns[half:])
    ]
    widest = max(sheet.shape[-1] for sheet in sheets)
    sheet = torch.cat([F.pad(each, (0, widest - each.shape[-1]), value=1.0) for each in sheets], dim=-2)
    pixels = (srgb_encode(sheet)[0].flip(0).movedim(0, -1) * 255).round().byte().numpy()
    cv2.imwrite(str(out), pixels, [cv2.IMWRITE_JPEG_QUALITY, 80])


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--exact", type=Path)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data/mwdn-camera/real-objects"))
    parser.add_argument("--recipe", default="benchmark-quarter")
    parser.add_argument("--record", type=Path, default=RECORD)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    arguments = parser.parse_args()
    benchmark = read_benchmark(arguments.recipe)
    name, recipe = next(iter(benchmark.data.items()))
    dataset = open_dataset(name, recipe, arguments.folder / "data", torch.device("cpu"), lambda title, rows: rows)
    runs = arguments.folder / "runs" / name
    weights = finished(runs, benchmark.schedule.steps)
    own = list(weights)
    if arguments.exact:
        exact = finished(arguments.exact / "runs" / name, benchmark.schedule.steps)
        others, exact = renamed(benchmark, exact, EXACT)
        benchmark, weights = replace(benchmark, methods=(*benchmark.methods, *others.methods)), weights | exact
    methods = reconstructors(benchmark, dataset, weights)
    psnr = mismatch(benchmark, dataset, weights, methods, arguments.record)
    colours = dict(zip(methods, [*matplotlib.colormaps["tab20"].colors] * 2, strict=False))
    figure = Figure(figsize=(13, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_learning(left, runs, {label: colours[label] for label in own}, benchmark.schedule.batch)
    draw_mismatch(right, {label: psnr[label] for label in methods}, colours)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.legend(*right.get_legend_handles_labels(), loc="outside right center", fontsize=8)
    figure.savefig(arguments.out / "claims-curves.png", dpi=90)
    draw_captures(methods, dataset, arguments.captures, arguments.out / "claims-captures.jpg")


if __name__ == "__main__":
    with torch.inference_mode():
        main()
