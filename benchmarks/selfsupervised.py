"""Self-supervised training on a camera's own captures, scored with ground truth that the training does not use.

    python benchmarks/selfsupervised.py ../shared/data [--exact] [--electrons 15000] [--count 24] [--steps 100]

Captures as in benchmarks/universal.py, through the paper's PSF, mismatched by default. `universal` reconstructs them,
is trained on them by the recipe selfsupervised (in a folder of runs/, where a stopped run continues), and
reconstructs them again. Scored as in `mwdn evaluate` (full, clipped). Rows of earlier calls for another camera or light
stay in the record.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

import mwdn
from mwdn.data.photographs import Photographs
from mwdn.data.unpaired import UnpairedCaptures
from mwdn.training.recipe import read_recipe
from mwdn.training.selfsupervised import SelfSupervisedTask
from mwdn.training.trainer import Trainer
from universal import METRICS, camera, captures, gain, keep, measured


def tell(step):
    if step.validation is not None:
        print(f"step {step.step}, loss {step.validation.loss:.4f}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--electrons", type=float, default=15_000.0)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/selfsupervised.json"))
    arguments = parser.parse_args()
    mwdn.keep_memory()
    calibration = camera(arguments.data, "mwdn-camera 320x320")
    photographs = Photographs(arguments.data / "photos" / "test")
    made = captures(
        calibration.psf,
        photographs,
        read_recipe("mismatched"),
        arguments.electrons,
        range(arguments.count),
        exact=arguments.exact,
    )
    recipe = read_recipe("selfsupervised")
    recipe = replace(recipe, schedule=replace(recipe.schedule, steps=arguments.steps))
    own = UnpairedCaptures(
        torch.stack([measurement for measurement, _ in made]),
        calibration.psf,
        recipe.selfsupervised,
        recipe.schedule.seed,
    )
    run = Path(f"runs/selfsupervised-{'exact' if arguments.exact else 'mismatched'}-{arguments.electrons:.0f}")
    Trainer(recipe, SelfSupervisedTask(own), out=run, calibration=calibration).run(tell)
    methods = {"before": "universal", "after": str(run / "best.safetensors")}
    values = measured(methods, made, calibration)
    for name, each in values.items():
        print(name, {key: round(fmean(each[key]), 3) for key in METRICS})
    print("gain in dB", gain(values["after"], values["before"]))
    row = {"full_well": arguments.electrons, "exact": arguments.exact, "steps": arguments.steps, "values": values}
    rows = json.loads(arguments.out.read_text()) if arguments.out.exists() else []
    rows = [old for old in rows if any(old[key] != row[key] for key in ("full_well", "exact"))] + [row]
    keep(rows, arguments.out)


if __name__ == "__main__":
    main()
