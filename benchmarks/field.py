"""The cost of using one PSF when the PSF changes over the field.

    python benchmarks/field.py [--size 160]

A contour mask's PSF is magnified, sheared and blurred towards the corners by increasing amounts. Captures of the
bundled pictures, 0.7 of the field wide, are reconstructed with the PSF on the axis by Wiener and ADMM; one gain and
offset per picture. Vignetting is omitted: it only darkens. Prints a table and writes it as JSON.
"""

import argparse
import json
from importlib.resources import files
from pathlib import Path

import torch
from torch.nn import functional as F

from mwdn.evaluation.metrics import best_gain, psnr
from mwdn.io.images import read_picture
from mwdn.optics import Aberration, FieldCamera, field_psfs, sample_camera
from mwdn.optics.psf_measures import likeness
from mwdn.solvers import build

CORNER = Aberration(scale=0.01, stretch=0.01, blur_px=0.5)
FACTORS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
GRID, RANK = (9, 9), 12
EXTENT = 0.7


def scenes(size):
    """The bundled pictures in the centre of a dark field."""
    names = ("astronaut", "coffee", "cat")
    pictures = [read_picture(str(files("mwdn") / "io" / "pictures" / f"{name}.jpg")) for name in names]
    margin = round((1 - EXTENT) / 2 * size)
    inner = (size - 2 * margin,) * 2
    return torch.cat([F.pad(F.interpolate(picture, inner, mode="area"), (margin,) * 4) for picture in pictures])


def parts(size):
    """Masks of the picture's inner quarter, and of the area within a tenth of its side from its border."""
    place = torch.linspace(-1, 1, size).abs() / EXTENT
    distance = torch.maximum(place[:, None], place)
    return {"centre": distance < 0.5, "border": (distance > 0.8) & (distance < 1)}


def measure(factor, size):
    generator = torch.Generator().manual_seed(0)
    psf = sample_camera(generator, (size, size), family="contours")
    psfs = field_psfs(psf, GRID, CORNER * factor)
    camera = FieldCamera.from_psfs(psfs, (size, size), rank=RANK)
    scene = scenes(size)
    captured = camera.simulate(scene, generator=generator)
    row = {
        "factor": factor,
        "corner_likeness": likeness(psfs[0, 0][None], psf),
        "truncation": camera.truncation,
    }
    for name in ("wiener", "admm"):
        result = best_gain(build(name)(captured, psf), scene)
        row[name] = psnr(result, scene).mean().item()
        for part, mask in parts(size).items():
            error = (result - scene)[..., mask].square().mean((1, 2))
            row[f"{name}_{part}"] = (-10 * error.log10()).mean().item()
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=160)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/field.json"))
    arguments = parser.parse_args()
    rows = [measure(factor, arguments.size) for factor in FACTORS]
    print(
        "| magnification, shear | blur / px | correlation of the corner | Wiener / dB | centre, border | ADMM / dB |"
        " centre, border |\n| --- | --- | --- | --- | --- | --- | --- |"
    )
    for row in rows:
        corner = CORNER * row["factor"]
        cells = [f"{100 * corner.scale:.1f} %", f"{corner.blur_px:.2f}", f"{row['corner_likeness']:.2f}"]
        for name in ("wiener", "admm"):
            cells += [f"{row[name]:.2f}", f"{row[f'{name}_centre']:.1f}, {row[f'{name}_border']:.1f}"]
        print(f"| {' | '.join(cells)} |")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    content = {"size": arguments.size, "grid": GRID, "rank": RANK, "rows": rows}
    arguments.out.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
