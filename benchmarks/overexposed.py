"""Overexposed captures: what saturation costs each method.

    python benchmarks/overexposed.py ../shared/data [--count 4] [--psfs "mwdn-camera 320x320" ...] [--pairs dc.h5]

Test photographs as in benchmarks/universal.py, 15,000 electrons at saturation, exact PSF, the brightest pixel at 0.9
to 2 times saturation, scored in full. `--pairs`: real captures too, DiffuserCam's pairs (`mwdn import diffusercam`), as
they are and with the brightest tenth of their pixels cut off, scored on rows 60:270 and columns 60:440. PSNR, clipped,
with the best gain and offset, means. Prints the table and writes the numbers of each picture. Rows that are already in
the record are not measured again.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

import mwdn
from mwdn import Reconstructor
from mwdn.data.pairs import PairFile
from mwdn.data.photographs import Photographs
from mwdn.evaluation import Protocol
from mwdn.evaluation.metrics import measure
from mwdn.training.recipe import read_recipe
from universal import PSFS, camera, captures, keep

EXPOSURES = 0.9, 1.2, 1.5, 2.0
KEPT = 1.0, 0.9
"""Quantile of a real capture at which it is cut off."""

METHODS = "universal", "pyramid", "universal-small", "admm", "fista"


def simulated(data, name, count):
    """Row, captures with scenes, and protocol for each exposure."""
    recipe, photographs = read_recipe("mismatched"), Photographs(data / "photos" / "test")
    for exposure in EXPOSURES:
        exposed = replace(recipe, placement=replace(recipe.placement, exposure=(exposure, exposure)))
        made = captures(camera(data, name).psf, photographs, exposed, 15_000.0, range(count), exact=True)
        yield f"{name}, exposure {exposure}", made, Protocol.parse("full")


def real(pairs):
    """The same for captures of a file of pairs, cut off at a quantile."""
    file = PairFile(pairs)
    for kept in KEPT:
        made = [(b.clamp(max=float(b.quantile(kept))), v) for b, v in map(file.__getitem__, range(len(file)))]
        yield f"real DiffuserCam pairs, {1 - kept:.0%} cut off", made, Protocol.parse("60:270,60:440")


def scores(reconstruct, made, protocol):
    pictures = ((reconstruct(measurement[None]), scene[None]) for measurement, scene in made)
    measured = (measure(*both, protocol, variant="best-gain", perceptual=None) for both in pictures)
    return [round(float(each["psnr"]), 3) for each in measured]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--psfs", nargs="+", choices=PSFS, default=list(PSFS)[:2])
    parser.add_argument("--pairs", type=Path)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/overexposed.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    rows = json.loads(arguments.out.read_text()) if arguments.out.exists() else []
    conditions = [(name, simulated(arguments.data, name, arguments.count)) for name in arguments.psfs]
    if arguments.pairs:
        conditions.append(("DiffuserCam 270x480", real(arguments.pairs)))
    print("PSNR in dB, means\n\n| captures | at the maximum |", " | ".join(METHODS), "|")
    print("| --- " * (2 + len(METHODS)) + "|")
    for name, conditioned in conditions:
        calibration = camera(arguments.data, name)
        for title, made, protocol in conditioned:
            row = next(
                (row for row in rows if (row["captures"], len(row["at_the_maximum"])) == (title, len(made))), None
            )
            if row is None:
                share = [float((b >= 0.995 * b.amax((-2, -1), keepdim=True)).float().mean()) for b, _ in made]
                values = {each: scores(Reconstructor(each, calibration), made, protocol) for each in METHODS}
                row = {"captures": title, "at_the_maximum": share, "values": values}
                rows = [*(other for other in rows if other["captures"] != title), row]
                keep(rows, arguments.out)
            means = " | ".join(f"{fmean(row['values'][method]):.2f}" for method in METHODS)
            print(f"| {title} | {fmean(row['at_the_maximum']):.1%} | {means} |", flush=True)


if __name__ == "__main__":
    main()
