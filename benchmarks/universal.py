"""The bundled networks against ADMM through PSFs they were not trained on: exact, mismatched and real-like cameras.

    python benchmarks/universal.py ../shared/data [--count 32] [--methods universal universal-small admm]
                                                [--psfs "mwdn-camera 320x320" ...] [--calibrations real-like]

Four measured PSFs; 15,000 and 2,000 electrons at saturation; test photographs placed and mismatched by the recipe
mismatched, or seen by cameras with all that real ones have, recipe real-like. `filling`: photographs that fill the
frame, exact PSF or mismatched. Hot pixels are replaced as in a capture's file. Scored as in `mwdn evaluate` (full,
clipped). Prints a table of means, with the confidence interval of the first method's gain over the last, and writes the
numbers of each picture, a few at a time. Numbers already in the record are not measured again, so a stopped run
continues; `--again` measures the named methods again. One process per core, of one thread each.

The method `fine-tuned` is, for each PSF, the network in `TUNED` that the recipe finetune made of `universal`.
"""

import argparse
import itertools
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean

import torch

import mwdn
from mwdn import Calibration, Reconstructor
from mwdn.calibration.corrections import Corrections
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import SimulatedPairs
from mwdn.evaluation import Perceptual, Protocol, bootstrap, evaluate
from mwdn.io.files import atomic
from mwdn.training.recipe import read_recipe

PSFS = {
    "mwdn-camera 320x320": ("mwdn-camera/psf_320.png", {}),
    "DiffuserCam 270x480": (
        "diffusercam/psf_recovered_270x480.npy",
        {"background": 0.0, "upside_down": True, "bgr": True},
    ),
    "DiffuserCam tutorial 300x400": ("diffusercam-tutorial/psf_sample.tif", {"bin": 4}),
    "PhlatCam 384x640": ("phlatcam/psf_384x640.npy", {"background": 0.0}),
}
TUNED = {name: f"runs/finetune-{path.partition('/')[0]}/best.safetensors" for name, (path, _) in PSFS.items()}
FULL_WELLS = (15_000.0, 2_000.0)
CALIBRATIONS = {
    "exact": "mismatched",
    "mismatched": "mismatched",
    "real-like": "real-like",
    "filling": "mismatched",
    "filling mismatched": "mismatched",
}
"""How well the PSF is known, and the recipe of the captures."""
KEYS = ("psf", "full_well", "calibration")
METRICS = ("psnr", "ssim", "lpips")
AT_ONCE = 8


def camera(data, name):
    path, options = PSFS[name]
    return Calibration.from_file(data / path, **options)


def recipe_of(known):
    """The recipe of the captures of a calibration."""
    recipe = read_recipe(CALIBRATIONS[known])
    if known.startswith("filling"):
        recipe = replace(recipe, placement=replace(recipe.placement, extent=(2.0, 2.0), aspect=1.0, offset=0.0))
    return recipe


def captures(psf, photographs, recipe, full_well, numbers, *, exact):
    psf = psf.expand(-1, 3, -1, -1)
    source = SimulatedPairs(
        photographs,
        psf / psf.sum((-2, -1), keepdim=True),
        placement=recipe.placement,
        mismatch=EXACT if exact else recipe.mismatch,
        sensor=replace(recipe.sensor, full_well=full_well),
        seed=11,
    )
    batches = [source.batch([number]) for number in numbers]
    correct = Corrections().of_capture  # replaces hot pixels, as `Calibration.correct` does
    return [(correct(pair.measurement)[0], pair.scene[0]) for pair in batches]


def measured(methods, made, calibration):
    """Lists of PSNR, SSIM and LPIPS of some captures for each method."""
    bound = {name: Reconstructor(method, calibration) for name, method in methods.items()}
    report = evaluate(bound, made, Protocol.parse("full"), perceptual=Perceptual.load()).methods
    return {name: {key: [round(value, 4) for value in report[name].values[key]] for key in METRICS} for name in methods}


def gain(values, other):
    """Gain of one method over another in PSNR, with its confidence interval."""
    both = zip(values["psnr"], other["psnr"], strict=True)
    return "{:+.2f} ({:.2f} to {:.2f})".format(*bootstrap([one - two for one, two in both]))


def remembered(out):
    """Values by method of each row in a record."""
    rows = {which: {} for which in itertools.product(PSFS, FULL_WELLS, CALIBRATIONS)}
    for row in json.loads(out.read_text()) if out.exists() else ():
        rows[tuple(row[key] for key in KEYS)] = row["values"]
    return rows


def lacking(rows, methods, count):
    """What remains to be measured: (row, numbers of captures, methods), the first captures of all rows first."""
    for first in range(0, count, AT_ONCE):
        numbers = range(first, min(first + AT_ONCE, count))
        for which, values in rows.items():
            left = [each for each in methods if each not in values or len(values[each]["psnr"]) < numbers.stop]
            if left:
                yield which, numbers, left


def keep(rows, out):
    """Write a record, one line per row."""
    with atomic(out) as temporary:
        temporary.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


def scores(data, which, numbers, methods):
    """Scores (`measured`) of captures through one PSF in one light."""
    torch.set_num_threads(1)
    mwdn.keep_memory()
    name, full_well, known = which
    calibration, photographs = camera(data, name), Photographs(data / "photos" / "test")
    is_exact = known in ("exact", "filling")
    made = captures(calibration.psf, photographs, recipe_of(known), full_well, numbers, exact=is_exact)
    return measured({each: TUNED[name] if each == "fine-tuned" else each for each in methods}, made, calibration)


def table(rows, methods):
    """Lines of means, and the gain of the first method over the last."""
    columns = ["PSF", "electrons", "calibration", "captures", *methods] + (["gain"] if len(methods) > 1 else [])
    yield f"| {' | '.join(columns)} |"
    yield "| --- " * len(columns) + "|"
    for (name, full_well, known), results in rows.items():
        count = min(len(results[method]["psnr"]) for method in methods)
        values = {method: {key: each[:count] for key, each in results[method].items()} for method in methods}
        cells = [name, f"{full_well:,.0f}", known, str(count)]
        cells += [f"{fmean(values[m]['psnr']):.2f} / {fmean(values[m]['lpips']):.3f}" for m in methods]
        if len(methods) > 1:
            cells.append(gain(values[methods[0]], values[methods[-1]]))
        yield f"| {' | '.join(cells)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--methods", nargs="+", default=["universal", "universal-small", "admm"])
    parser.add_argument("--psfs", nargs="+", choices=PSFS, default=list(PSFS))
    parser.add_argument("--calibrations", nargs="+", choices=CALIBRATIONS, default=list(CALIBRATIONS))
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/universal.json"))
    arguments = parser.parse_args()
    rows = remembered(arguments.out)
    wanted = {
        which: values
        for which, values in rows.items()
        if which[0] in arguments.psfs and which[2] in arguments.calibrations
    }
    if arguments.again:
        for values in wanted.values():
            for method in arguments.methods:
                values.pop(method, None)
    tasks = list(lacking(wanted, arguments.methods, arguments.count))
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as processes:
        work = [processes.submit(scores, arguments.data, *task) for task in tasks]
        for (which, numbers, _), done in zip(tasks, work, strict=True):
            for method, values in done.result().items():
                known = rows[which].setdefault(method, {key: [] for key in METRICS})
                for key in METRICS:
                    known[key][numbers.start : numbers.stop] = values[key]
            record = [
                dict(zip(KEYS, which, strict=True)) | {"values": values} for which, values in rows.items() if values
            ]
            keep(record, arguments.out)
    print("PSNR in dB / LPIPS, means; gain of the first method over the last (95 % confidence)\n")
    print("\n".join(table(wanted, arguments.methods)))


if __name__ == "__main__":
    main()
