"""How the PSF of the paper's camera changes with the distance of the point source.

    python benchmarks/distance.py [--out FILE]

The contour mask of docs/masks.md and its PSF at every distance (three wavelengths for the band), compared with that at
20 cm: as it is; after the magnification of similar triangles, (1 + z / d) / (1 + z / 200 mm), is undone; and the PSF at
20 cm warped by that magnification alone, with itself. z is the distance from mask to sensor, d that of the source.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from mwdn.io.files import write_json
from mwdn.optics import Contour, Setup, mask_psf
from mwdn.optics.psf_measures import likeness
from mwdn.optics.warp import warp

DISTANCES_MM = (200.0, 300.0, 400.0, 800.0, 2000.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/distance.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    setup = Setup(wavelengths=3)
    mask = Contour(size_mm=(3.2, 2.8)).build(replace(setup, wavelengths=13))
    reference = mask_psf(mask, setup)
    record = {}
    print("| source / cm | magnification | likeness | magnification undone | warped alone |\n" + "| --- " * 5 + "|")
    for mm in DISTANCES_MM:
        scale = (1 + setup.distance_mm / mm) / (1 + setup.distance_mm / 200)
        psf = mask_psf(mask, replace(setup, source_mm=mm))
        row = {"magnification": scale, "likeness": likeness(psf, reference)}
        row["undone"] = likeness(warp(psf, torch.eye(2) / scale), reference)
        row["warped"] = likeness(warp(reference, torch.eye(2) * scale), reference)
        record[f"{mm:g}"] = row
        values = f"{row['likeness']:.3f} | {row['undone']:.3f} | {row['warped']:.3f}"
        print(f"| {mm / 10:g} | {scale:.4f} | {values} |", flush=True)
    write_json(arguments.out, record)


if __name__ == "__main__":
    with torch.inference_mode():
        main()
