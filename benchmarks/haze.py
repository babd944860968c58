"""The haze that `align` finds where the camera has a known one, and what its error costs `universal`.

    python benchmarks/haze.py ../shared/data [--count 4] [--out benchmarks/results/haze.json]

Scenes on black through three measured PSFs, under which a part of the light is spread evenly; the PSF given lacks it.
Cost: PSNR with the haze found, less that with the true one. 15 minutes on one core.
Rows that are in the record are not measured again.
"""

import argparse
import json
from pathlib import Path
from statistics import fmean

import torch

import mwdn
from mwdn.data.photographs import Photographs
from mwdn.io.files import atomic
from mwdn.optics.warp import hazed
from mwdn.solvers import align
from universal import camera, captures, recipe_of

PSFS = "mwdn-camera 320x320", "DiffuserCam 270x480", "PhlatCam 384x640"
HAZES = 0.0, 0.02, 0.04, 0.1
LIGHTS = 15000.0, 2000.0


def row_name(psf, light, haze):
    return f"{psf}, {light:,.0f} e, {haze:.0%} haze"


@torch.no_grad()
def measured(network, psf, haze, pairs):
    """Haze found in each capture, and the cost of each error in dB."""
    found, costs = [], []
    for measurement, scene in pairs:
        pose = align(measurement[None], psf)
        true = pose._replace(haze=torch.tensor([haze]))
        pictures = [network(measurement[None], each.move(psf)).clamp(0, 1) for each in (pose, true)]
        psnr, best = (float(mwdn.psnr(picture, scene[None])) for picture in pictures)
        found.append(round(float(pose.haze), 4))
        costs.append(round(psnr - best, 3))
    return {"haze": found, "cost": costs}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=4, help="captures a row")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/haze.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    network, recipe = mwdn.load_network("universal").eval(), recipe_of("exact")
    photographs = Photographs(arguments.data / "photos/test")
    record = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    for name in PSFS:
        psf = camera(arguments.data, name).psf
        for haze in HAZES:
            for light in LIGHTS:
                if (key := row_name(name, light, haze)) in record:
                    continue
                pairs = captures(hazed(psf, haze), photographs, recipe, light, range(arguments.count), exact=True)
                row = record[key] = measured(network, psf, haze, pairs)
                print(f"{key}: {row['haze']}, {fmean(row['cost']):+.2f} dB", flush=True)
                with atomic(arguments.out) as temporary:
                    temporary.write_text(json.dumps(record, indent=1) + "\n")
    summarise(record)


def summarise(record):
    """Table over the PSFs: mean haze found and mean cost, in good and in low light."""
    print("| true haze | found, good light | cost / dB | found, low light | cost / dB |")
    print("| --- " * 5 + "|")
    for haze in HAZES:
        cells = []
        for light in LIGHTS:
            rows = [record[row_name(name, light, haze)] for name in PSFS]
            found, cost = (fmean(value for row in rows for value in row[key]) for key in ("haze", "cost"))
            cells += [f"{found:.1%}", f"{cost:+.2f}"]
        print(f"| {haze:.0%} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
