"""What each way in which real cameras differ costs: real-like captures with one key of [mismatch] at a time left out.

    python benchmarks/mismatches.py ../shared/data [--psf "DiffuserCam 270x480"] [--count 6] [--method universal]

Captures of the recipe real-like, 15,000 electrons. PSNR in dB, clipped as in benchmarks/universal.py, and with the best
gain and offset of each picture. Eight minutes on one core.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

import mwdn
from mwdn import Reconstructor
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.evaluation.metrics import best_gain, psnr
from mwdn.io.files import write_json
from universal import PSFS, camera, captures, recipe_of

LEFT_OUT = (
    *("", "turn_degrees", "scale", "blur_px", "haze", "envelope_shift", "aperture_gain", "tails", "off_axis"),
    *("depth", "vignetting", "tilt", "room_light", "hot_pixels", "gamma_coded"),
)


@torch.no_grad()
def scores(reconstruct, pairs):
    """Mean PSNR, clipped and with the best gain."""
    values = []
    for measurement, scene in pairs:
        picture, scene = reconstruct(measurement[None]), scene[None]
        values.append([float(psnr(each, scene)) for each in (picture.clamp(0, 1), best_gain(picture, scene))])
    return [round(fmean(column), 2) for column in zip(*values, strict=True)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--psf", choices=PSFS, default="DiffuserCam 270x480")
    parser.add_argument("--count", type=int, default=6)
    parser.add_argument("--method", default="universal")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/mismatches.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    calibration, recipe = camera(arguments.data, arguments.psf), recipe_of("real-like")
    photographs = Photographs(arguments.data / "photos" / "test")
    reconstruct, record = Reconstructor(arguments.method, calibration), {}
    print("| left out | clipped | best gain |\n| --- | --- | --- |")
    for key in LEFT_OUT:
        mismatch = replace(recipe.mismatch, **({key: getattr(EXACT, key)} if key else {}))
        numbers, seen = range(arguments.count), replace(recipe, mismatch=mismatch)
        pairs = captures(calibration.psf, photographs, seen, 15000.0, numbers, exact=False)
        record[key or "nothing"] = clipped, free = scores(reconstruct, pairs)
        print(f"| {key or 'nothing'} | {clipped:.2f} | {free:.2f} |", flush=True)
    write_json(arguments.out, {"psf": arguments.psf, "count": arguments.count, "psnr": record})


if __name__ == "__main__":
    main()
