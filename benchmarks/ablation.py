"""Ablation of the bundled network: one part removed at a time, without retraining.

    python benchmarks/ablation.py ../shared/data [--count 6]

Captures as in benchmarks/universal.py, through the paper's PSF: 15,000 and 2,000 electrons, exact and mismatched.
"""

import argparse
import json
from pathlib import Path
from unittest.mock import patch

import torch

from mwdn import Calibration
from mwdn.data.photographs import Photographs
from mwdn.evaluation import Perceptual, Protocol, evaluate
from mwdn.inference.methods import find_method
from mwdn.solvers import Pyramid, align
from mwdn.training.recipe import read_recipe
from universal import FULL_WELLS, captures


def parts(psf):
    """The whole network and its ablations, as functions of the measurement."""
    network = find_method("universal").eval()

    def aligned(method):
        return lambda measurement: method(measurement, align(measurement, psf).move(psf))

    whole = aligned(network)

    def changed(target, **attributes):
        def reconstruct(measurement):
            with patch.multiple(target, **attributes):
                return whole(measurement)

        return reconstruct

    return {
        "whole": whole,
        "PSF not aligned": lambda b: network(b, psf),
        "haze not found": lambda b: network(b, align(b, psf)._replace(haze=0.0).move(psf)),
        "no plug and play": changed(network, rounds=0),
        "U-Net free to change the mean light": changed(network, mean_light="free"),
        "U-Net that keeps the mean light": changed(network, mean_light="kept"),
        "no U-Net: plug and play, PSF aligned": aligned(lambda *known: network.estimates(*known)[:, :3]),
        "neither: pyramid, PSF aligned": aligned(Pyramid()),
        "neither: pyramid, PSF not aligned": lambda b: Pyramid()(b, psf),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/ablation.json"))
    arguments = parser.parse_args()
    recipe = read_recipe("mismatched")
    photographs, perceptual = Photographs(arguments.data / "photos" / "test"), Perceptual.load()
    psf = Calibration.from_file(arguments.data / "mwdn-camera" / "psf_320.png").psf
    scores = {name: [] for name in parts(psf)}
    for full_well in FULL_WELLS:
        for exact in (True, False):
            made = captures(psf, photographs, recipe, full_well, range(arguments.count), exact=exact)
            report = evaluate(parts(psf), made, Protocol.parse("full"), perceptual=perceptual)
            for name, rows in scores.items():
                rows.append([report.methods[name].summary(key)[0] for key in ("psnr", "lpips")])
    print(f"PSNR in dB / LPIPS, means of {arguments.count}\n")
    conditions = [f"{n:,.0f} e, {kind}" for n in FULL_WELLS for kind in ("exact", "mismatched")]
    print("| |", " | ".join(conditions), "|")
    print("| --- " * (1 + len(conditions)) + "|")
    for name, rows in scores.items():
        print("|", name, "|", " | ".join(f"{psnr:.2f} / {lpips:.3f}" for psnr, lpips in rows), "|")
    arguments.out.write_text(
        json.dumps({"count": arguments.count, "conditions": conditions, "found": scores}, indent=1)
    )


if __name__ == "__main__":
    with torch.inference_mode():
        main()
