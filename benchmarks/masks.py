"""Contour mask against diffuser in the paper's camera: more scenes, light levels and a mismatch than docs/masks.md has.

    python benchmarks/masks.py ../shared/data/photos/test [--count 6] [--out FILE]

Photographs fill 137 of 320 pixels, as the paper's display does; the brightest pixel is near saturation in every
capture, so a mask of higher contrast gets less light. Mismatch: half a degree of rotation, 10 % of even light, field
dependence (`mwdn-sim`). PSNR of the central 128 x 128 pixels, and the difference of the two masks with its interval
(bootstrap over the photographs). First the ratio of the moduli of their spectra by spatial frequency; ``--count 0``
prints it alone.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

from mwdn import Calibration, Reconstructor
from mwdn.benchmark.dataset_recipe import PRESETS
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import SimulatedPairs
from mwdn.evaluation import Protocol, bootstrap, measure
from mwdn.io.files import write_json
from mwdn.optics import Contour, Deviation, Diffuser, Sensor, Setup, unit_sum
from mwdn.optics.design import design_camera
from mwdn.optics.psf_spectrum import radial_spectrum

SETTINGS = {
    "15,000 e, exact": (Sensor(15000.0, 3.0), Deviation()),
    "1,000 e, exact": (Sensor(1000.0, 3.0), Deviation()),
    "15,000 e, mismatched": (Sensor(15000.0, 3.0), PRESETS["mwdn-sim"].deviation),
}
METHODS = ("wiener", "pyramid")


def scores(psf, photographs, count):
    """PSNR of each photograph, by setting and method."""
    calibration, result = Calibration(psf), {}
    for setting, (sensor, deviation) in SETTINGS.items():
        camera = replace(deviation).camera(psf)
        placement = PRESETS["mwdn-sim"].placement
        source = SimulatedPairs(
            photographs, psf, placement=placement, mismatch=EXACT, sensor=sensor, seed=0, camera=camera
        )
        measurements, scenes = source.batch(range(count))[:2]
        for method in METHODS:
            reconstruct = Reconstructor(method, calibration, device="cpu")
            pictures = torch.cat([reconstruct(each[None]) for each in measurements])
            values = measure(pictures, scenes, Protocol.parse("centre-128"), variant="raw")["psnr"].tolist()
            result[f"{setting}, {method}"] = values
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--count", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/masks.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    setup, record, spectra = Setup(wavelengths=13), {}, []
    for name, design in (("contour", Contour(size_mm=(3.2, 2.8))), ("diffuser", Diffuser())):
        psf = unit_sum(design_camera(name, design, setup).psf)
        spectra.append(radial_spectrum(psf))
        if arguments.count:
            record[name] = scores(psf, Photographs(arguments.photographs), arguments.count)
    ratio = spectra[1] / spectra[0]  # entry i is at i / 120 cycles per pixel
    print("diffuser over contour:", ", ".join(f"{i / 120:.2f}: {ratio[i]:.2f}" for i in (2, 4, 6, 8, 12, 24, 36, 48)))
    if not record:
        return
    write_json(arguments.out, record)
    print("| setting, method | contour / dB | diffuser / dB | difference / dB |\n" + "| --- " * 4 + "|")
    for key, contour in record["contour"].items():
        diffuser = record["diffuser"][key]
        gap = "{:+.2f} ({:+.2f} to {:+.2f})".format(*bootstrap([b - a for a, b in zip(contour, diffuser, strict=True)]))
        print(f"| {key} | {fmean(contour):.2f} | {fmean(diffuser):.2f} | {gap} |")


if __name__ == "__main__":
    with torch.inference_mode():
        main()
