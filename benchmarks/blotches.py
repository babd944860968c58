"""Light beside an object on black that no light caused: what each way in which real cameras differ contributes.

    python benchmarks/blotches.py ../shared/data [--count 4] [--methods admm pyramid] [--out FILE]

A photograph on a third of the frame, the rest black, through the paper's PSF; one key of [mismatch] at a time, up to
the largest value of the recipe real-like. The black part is averaged over blocks of 16 x 16 pixels. Printed are its
mean and the root mean square difference of its colours, both in per cent of the photograph's mean.
"""

import argparse
from dataclasses import fields, replace
from pathlib import Path
from statistics import fmean

import torch
from torch.nn import functional as F

import mwdn
from mwdn import Reconstructor
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import SimulatedPairs
from mwdn.io.files import write_json
from mwdn.training.recipe import read_recipe
from universal import camera

BLOCK = 16
MARGIN = 4  # pixels around the photograph that are not counted: its blurred border


def blotches(picture, scene):
    """Mean and colour of the black part of a reconstruction, in per cent of the photograph's mean."""
    lit = (scene.amax(1, keepdim=True) > 0).float()
    black = 1 - F.max_pool2d(lit, 2 * MARGIN + 1, 1, MARGIN)
    whole = F.avg_pool2d(black, BLOCK)[0, 0] == 1
    light = F.avg_pool2d(picture, BLOCK)[0][:, whole] / ((picture * lit).sum() / lit.sum() / picture.shape[1])
    return 100 * float(light.mean()), 100 * float((light - light.mean(0)).square().mean().sqrt())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--methods", nargs="+", default=["admm", "pyramid"])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/blotches.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    calibration, recipe = camera(arguments.data, "mwdn-camera 320x320"), read_recipe("real-like")
    psf = calibration.psf.expand(-1, 3, -1, -1)
    placement = replace(
        recipe.placement, extent=(0.35, 0.4), aspect=1.0, ambient=(0.0, 0.0), exposure=(0.8, 0.9), offset=0.1
    )
    methods = {name: Reconstructor(name, calibration, align=name != "admm") for name in arguments.methods}
    record = {}
    print(f"| mismatch | largest | {' | '.join(methods)} |\n{'| --- ' * (2 + len(methods))}|")
    for key in ("", *(field.name for field in fields(EXACT) if field.name != "exact")):
        largest = getattr(recipe.mismatch, key) if key else 0
        if key and largest == getattr(EXACT, key):
            continue
        source = SimulatedPairs(
            Photographs(arguments.data / "photos" / "test"),
            psf / psf.sum((-2, -1), keepdim=True),
            placement=placement,
            mismatch=replace(EXACT, **{key: largest}) if key else EXACT,
            sensor=recipe.sensor,
            seed=11,
        )
        pairs = [source.batch([number]) for number in range(arguments.count)]
        row = {}
        for name, method in methods.items():
            values = zip(*(blotches(method(pair.measurement), pair.scene) for pair in pairs), strict=True)
            row[name] = [round(fmean(value), 3) for value in values]
        record[key or "none"] = {"largest": largest} | row
        cells = [f"{mean:.2f} / {colour:.2f}" for mean, colour in row.values()]
        print(f"| {key or 'none'} | {largest or ''} | {' | '.join(cells)} |", flush=True)
    write_json(arguments.out, record)


if __name__ == "__main__":
    main()
