"""The bundled networks against ADMM through PSFs they have never seen: exact and mismatched, in good and poor light.

    python benchmarks/universal.py ../shared/data [--count 32] [--methods universal universal-small admm]

Four measured PSFs; test photographs placed and mismatched as recipes/mismatched.toml says; 15,000 and 2,000 electrons
at saturation. Measured as `mwdn evaluate` measures (full, clipped). Prints a table and writes it with all means and
what `universal` gains over ADMM, with its confidence interval; methods that are not named keep what the
record has of them, if it is of as many captures. A process for each core, of one thread each.
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
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import EXACT, SimulatedPairs
from mwdn.evaluation import Perceptual, Protocol, bootstrap, evaluate
from mwdn.learning.recipe import read_recipe

PSFS = {
    "mwdn-camera 320x320": ("mwdn-camera/psf_320.png", {}),
    "DiffuserCam 270x480": (
        "diffusercam/psf_recovered_270x480.npy",
        {"background": 0.0, "upside_down": True, "bgr": True},
    ),
    "DiffuserCam tutorial 300x400": ("diffusercam-tutorial/psf_sample.tif", {"binning": 4}),
    "PhlatCam 384x640": ("phlatcam/psf_384x640.npy", {"background": 0.0}),
}
FULL_WELLS = (15_000.0, 2_000.0)
MISMATCHED = Path(__file__).parents[1] / "recipes" / "mismatched.toml"


def captures(psf, photographs, recipe, full_well, count, *, exact):
    psf = psf.expand(-1, 3, -1, -1)
    source = SimulatedPairs(
        photographs,
        psf / psf.sum((-2, -1), keepdim=True),
        placement=recipe.placement,
        mismatch=EXACT if exact else recipe.mismatch,
        sensor=replace(recipe.sensor, full_well=full_well),
        seed=11,
    )
    batches = [source.batch([number]) for number in range(count)]
    return [(pair.measurement[0], pair.scene[0]) for pair in batches]


def scores(task):
    """PSNR, SSIM and LPIPS of each picture by each method, through one PSF in one light."""
    data, count, methods, name, full_well, exact = task
    torch.set_num_threads(1)
    mwdn.keep_memory()
    path, options = PSFS[name]
    calibration, recipe = Calibration.from_file(data / path, **options), read_recipe(MISMATCHED)
    photographs = Photographs(data / "photos" / "test")
    made = captures(calibration.psf, photographs, recipe, full_well, count, exact=exact)
    bound = {method: Reconstructor(method, calibration) for method in methods}
    report = evaluate(bound, made, Protocol.parse("full"), perceptual=Perceptual.load()).methods
    values = {
        method: {key: [round(value, 4) for value in report[method].values[key]] for key in ("psnr", "ssim", "lpips")}
        for method in methods
    }
    return {"psf": name, "full_well": full_well, "exact": exact, "values": values}


def gain(values):
    """What `universal` gains over ADMM in PSNR: mean of the pictures and its confidence interval."""
    both = zip(values["universal"]["psnr"], values["admm"]["psnr"], strict=True)
    return bootstrap([one - other for one, other in both])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--methods", nargs="+", default=["universal", "universal-small", "admm"])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/universal.json"))
    arguments = parser.parse_args()
    record = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    same = record["rows"] if record.get("count") == arguments.count else []
    known = {(row["psf"], row["full_well"], row["exact"]): row["values"] for row in same}
    rows = []
    print(f"PSNR in dB / LPIPS, means of {arguments.count}; what universal gains over ADMM (95 % confidence)\n")
    methods = sorted({*arguments.methods, *(method for values in known.values() for method in values)})
    print("| PSF | electrons | calibration |", " | ".join(methods), "| gain |")
    print("| --- " * (4 + len(methods)) + "|")
    tasks = [
        (arguments.data, arguments.count, arguments.methods, *which)
        for which in itertools.product(PSFS, FULL_WELLS, (True, False))
    ]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as processes:
        for row in processes.map(scores, tasks):
            name, full_well, exact = row["psf"], row["full_well"], row["exact"]
            row["values"] = known.get((name, full_well, exact), {}) | row["values"]
            rows.append(row)
            means = {m: {key: fmean(values) for key, values in each.items()} for m, each in row["values"].items()}
            row["means"] = means
            told = " | ".join(f"{means[m]['psnr']:.2f} / {means[m]['lpips']:.3f}" for m in methods)
            told += " | "
            if {"universal", "admm"} <= means.keys():
                row["gain"] = gain(row["values"])
                told += "{:+.2f} ({:.2f} to {:.2f})".format(*row["gain"])
            print(f"| {name} | {full_well:,.0f} | {'exact' if exact else 'mismatched'} | {told} |", flush=True)
    lines = ",\n".join(json.dumps(row) for row in rows)
    arguments.out.write_text(f'{{"count": {arguments.count}, "rows": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
