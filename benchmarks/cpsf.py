"""Why MWDN-CPSF does not learn as published: scales of its filters, and the first steps of its training.

    mwdn benchmark benchmark-ablation --out runs/ablation-1 --seed 1
    python benchmarks/cpsf.py runs/ablation-1 [--steps 200]

The first table is of new networks in training mode and of trained ones, on four training captures: the median of |H|
of the PSFs that the filters divide by; the part of the frequencies with |H|^2 > lambda, which are inverted; the
contrast of the features (standard deviation) before and behind the filter. Then, whether the corrected PSFs of scale
1 are nearer to the true camera's PSF than to the calibrated one that they are made from. The second trains variants
for ``--steps`` of the recipe's 1,000, with its pairs, seed and rate; about a minute of processor time for each 200.
Writes `benchmarks/results/cpsf.json`.
"""

import argparse
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from mwdn.benchmark.recipe_reader import read_benchmark
from mwdn.benchmark.sets import open_dataset
from mwdn.benchmark.training import schedule_on
from mwdn.fourier.transforms import transfer_function
from mwdn.networks import build
from mwdn.networks.wiener_filter import normalise_psf
from mwdn.optics.psf_measures import likeness
from mwdn.optics.warp import warp
from mwdn.training.recipe import Recipe
from mwdn.training.tasks import SupervisedTask, supervised_task
from mwdn.training.trainer import Trainer
from mwdn.training.validation import Validator
from mwdn.weights.checkpoint import load_checkpoint

RECORD = Path(__file__).parent / "results" / "cpsf.json"
VARIANTS = {
    "published": {"regularisation": 1e-2},
    "lambda 64": {"regularisation": 64.0},
    "scaled, lambda 1.6e-6": {"orthonormal": True, "regularisation": 1.6e-6},
    "scaled, lambda 1e-2": {"orthonormal": True},
    "scaled, lambda 0.1": {"orthonormal": True, "regularisation": 0.1},
}


def turned(psf, degrees):
    """The PSF of the true camera on its axis: that of the calibration, rotated."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return warp(psf, torch.tensor([[cosine, sine], [-sine, cosine]]))


@torch.no_grad()
def scales(network, measurement, psf):
    """Numbers of each scale's filter."""
    psfs = network.pyramid(normalise_psf(psf, measurement.shape[-2:], network.channels))
    features, rows = network.encoder(measurement), []
    for wiener, h, before in zip(network.filters, psfs, features, strict=False):
        H = transfer_function(h * (1 if wiener.weight is None else wiener.weight), wiener.grid(h)).abs()
        after = wiener.deconvolve(before, wiener.prepare(h))
        contrast = [each.std((-2, -1)).mean().item() for each in (before, after)]
        inverted = (H.square() > wiener.regularisation).float().mean().item()
        rows.append({"median": H.median().item(), "inverted": inverted, "before": contrast[0], "behind": contrast[1]})
    return rows


@torch.no_grad()
def resemblance(network, calibrated, true):
    """Likeness of the corrected PSFs at scale 1, mean and largest over the channels, with two PSFs."""
    psfs = network.pyramid(normalise_psf(calibrated, calibrated.shape[-2:], network.channels))[0].split(1, dim=1)
    both = [[likeness(h, psf) for h in psfs] for psf in (calibrated, true)]
    return {name: [sum(row) / len(row), max(row)] for name, row in zip(("calibrated", "true"), both, strict=True)}


def trial(options, dataset, benchmark, method, steps):
    """PSNR and loss of the validation after the first steps of the recipe's training."""
    schedule = replace(schedule_on(method, benchmark, dataset), validation=len(dataset.training[1]), seed=1)
    recipe = Recipe({"name": method.name, **method.options, **options}, schedule, benchmark.loss)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(
            recipe,
            supervised_task(dataset.training[0], schedule),
            out=Path(folder),
            calibration=dataset.calibration,
            validator=Validator(recipe, SupervisedTask(dataset.training[1]), dataset.calibration.psf),
        )
        for _ in range(steps):
            trainer.advance()
        validation = trainer.validate()
    return {"steps": steps, "psnr": validation.psnr, "loss": validation.loss}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=0)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    benchmark = read_benchmark("benchmark-ablation")
    name, sets = next(iter(benchmark.data.items()))
    dataset = open_dataset(name, sets, arguments.folder / "data", torch.device("cpu"), lambda title, rows: rows)
    methods = {method.label: method for method in benchmark.methods}
    measurement, psf = dataset.training[0].batch(range(4))[0], dataset.calibration.psf
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    record = {"scales": {}, "likeness": {}, "trials": {}} | record
    for label in ("mwdn", "mwdn-cpsf", "mwdn-cpsf-orthonormal"):
        torch.manual_seed(1)
        network = build(methods[label].name, **methods[label].options).train()
        record["scales"][f"{label}, new"] = scales(network, measurement, psf)
        weights = arguments.folder / "runs" / name / label / "best.safetensors"
        if weights.exists():
            network = load_checkpoint(weights).eval()
            record["scales"][f"{label}, trained"] = scales(network, measurement, psf)
            if methods[label].name == "mwdn-cpsf":
                record["likeness"][label] = resemblance(network, psf, turned(psf, sets.deviation.turn_degrees))
    for variant in arguments.variants if arguments.steps else ():
        record["trials"][variant] = trial(VARIANTS[variant], dataset, benchmark, methods["mwdn-cpsf"], arguments.steps)
    RECORD.write_text(json.dumps(record, indent=1) + "\n")
    print("| network | scale | median of H | inverted | features before | behind |\n" + "| --- " * 6 + "|")
    for label, rows in record["scales"].items():
        for scale, row in enumerate(rows):
            numbers = f"{row['median']:.2g} | {row['inverted']:.0%} | {row['before']:.2f} | {row['behind']:.2g}"
            print(f"| {label} | 1/{2**scale} | {numbers} |")
    for label, row in record["likeness"].items():
        values = [f"{mean:.3f} ({largest:.3f})" for mean, largest in row.values()]
        print(f"{label}: likeness of its PSFs to the calibrated one {values[0]}, to the true one {values[1]}")
    for variant, row in record["trials"].items():
        print(f"{variant}: {row['psnr']:.2f} dB, loss {row['loss']:.3f} after {row['steps']} steps")


if __name__ == "__main__":
    main()
