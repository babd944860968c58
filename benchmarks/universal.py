"""The bundled networks against ADMM through PSFs they have never seen: exact and mismatched, in good and poor light.

    python benchmarks/universal.py ../shared/data [--count 6] [--methods universal universal-small admm]

Four measured PSFs; test photographs placed and mismatched as recipes/mismatched.toml says; 15,000 and 2,000 electrons
at saturation. Measured as `mwdn evaluate` measures (full, clipped). Prints a table and writes it with all means;
methods that are not named keep what the record has of them, if it is of as many captures.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

from mwdn import Calibration, Reconstructor
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import EXACT, SimulatedPairs
from mwdn.evaluation import Perceptual, Protocol, evaluate
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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=6)
    parser.add_argument("--methods", nargs="+", default=["universal", "universal-small", "admm"])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/universal.json"))
    arguments = parser.parse_args()
    recipe = read_recipe(Path(__file__).parents[1] / "recipes" / "mismatched.toml")
    photographs, perceptual = Photographs(arguments.data / "photos" / "test"), Perceptual.load()
    record = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    same = record["rows"] if record.get("count") == arguments.count else []
    known = {(row["psf"], row["full_well"], row["exact"]): row["means"] for row in same}
    rows = []
    print(f"PSNR in dB / LPIPS, means of {arguments.count}\n")
    print("| PSF | electrons | calibration |", " | ".join(arguments.methods), "|")
    print("| --- " * (3 + len(arguments.methods)) + "|")
    for name, (path, options) in PSFS.items():
        calibration = Calibration.from_file(arguments.data / path, **options)
        bound = {method: Reconstructor(method, calibration) for method in arguments.methods}
        for full_well in FULL_WELLS:
            for exact in (True, False):
                made = captures(calibration.psf, photographs, recipe, full_well, arguments.count, exact=exact)
                report = evaluate(bound, made, Protocol.parse("full"), perceptual=perceptual)
                means = {m: {k: report.methods[m].summary(k)[0] for k in ("psnr", "ssim", "lpips")} for m in bound}
                kept = known.get((name, full_well, exact), {})
                rows.append({"psf": name, "full_well": full_well, "exact": exact, "means": kept | means})
                told = " | ".join(f"{each['psnr']:.2f} / {each['lpips']:.3f}" for each in means.values())
                print(f"| {name} | {full_well:,.0f} | {'exact' if exact else 'mismatched'} | {told} |", flush=True)
    arguments.out.write_text(json.dumps({"count": arguments.count, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
