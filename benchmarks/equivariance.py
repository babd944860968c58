"""How much a picture changes with the direction and the place of what is in it, and what `ensemble` gains.

    python benchmarks/equivariance.py [--size 63] [--count 8] [--methods admm universal-small ...]
    python benchmarks/equivariance.py --gain ../shared/data [--count 8] [--methods universal] [--psfs NAME ...]

First form: a capture is mirrored (with its PSF), moved by 5 pixels, or put into a batch; the picture should be
mirrored, moved, or the same. The relative difference is measured for two kinds of captures of random scenes and
contour PSFs:

- inside: scene and PSF are small, and the whole pattern lies inside the sensor. The border plays no part: what is left
  is the method's own bias, such as a network's preference of a direction or the grid of its pooling.
- cut: scene and PSF fill the sensor, which cuts off a part of the pattern, another part in a moved capture.

Second form: PSNR with and without `ensemble` in the rows of benchmarks/universal.py, and on the real DiffuserCam pairs
(best gain and offset), with the 95 % confidence interval of the gain. Both write their numbers to --out.
"""

import argparse
import json
import tempfile
from pathlib import Path
from statistics import fmean

import torch
from torch.nn import functional as F

import mwdn
import universal
from mwdn import Calibration, Camera, Reconstructor
from mwdn.data.importers import import_pairs
from mwdn.data.pairs import PairFile
from mwdn.data.photographs import Photographs
from mwdn.evaluation import Perceptual, Protocol, bootstrap, evaluate
from mwdn.io.files import atomic
from mwdn.optics.drawing import contour_lines
from mwdn.optics.orientation import turn
from mwdn.optics.sensor import Sensor
from mwdn.training.recipe import read_recipe

METHODS = ["wiener", "admm", "fista", "pyramid", "universal", "universal-small"]
PARTS = {"inside": 0.4, "cut": 1.0}
"""Part of the frame's width that the scene fills, and that the PSF's aperture has."""
MOVE = 5
FULL, NONE = Protocol.parse("full"), Perceptual.none("PSNR alone")


def smooth(size, cell, generator):
    coarse = torch.randn(1, 1, size // cell + 3, size // cell + 3, generator=generator)
    return F.interpolate(coarse, size=(size, size), mode="bicubic", align_corners=True)


def window(size, width):
    """1 in the middle ``width`` pixels of each axis, fading to 0 over 3 pixels."""
    distance = (torch.arange(size) - size // 2).abs()
    axis = ((width / 2 - distance) / 3).clamp(0, 1)
    return axis[:, None] * axis


def captures(size, part, generator):
    """PSF, a capture, and the same sensor moved by `MOVE` pixels over the same light."""
    aperture = window(size, part * size if part < 1 else 0.75 * size)
    psf = contour_lines(smooth(size, 10, generator), 1.2) * aperture
    psf = (psf / psf.sum()).expand(-1, 3, -1, -1)
    large = 2 * size + 1  # light comes from outside the frame, too
    scene = smooth(large, 8, generator).sigmoid() * window(large, part * size if part < 1 else large)
    plane = Camera(psf, size=(large, large))(scene.expand(-1, 3, -1, -1))
    plane = Sensor(full_well=15_000.0).expose(plane, generator=generator)
    start = (large - size) // 2
    there, moved = (plane[..., first : first + size, first : first + size] for first in (start, start + MOVE))
    return psf, there, moved


def difference(one, other):
    return float((one - other).norm() / other.norm())


def changes(method, psf, capture, moved):
    """Relative difference for each change."""
    reconstruct = Reconstructor(method, Calibration(psf), device="cpu")
    mirrored = Reconstructor(method, Calibration(turn(psf, "flip-left-right")), device="cpu")
    picture = reconstruct(capture)
    inner = slice(MOVE, picture.shape[-1] - MOVE)
    back = slice(0, picture.shape[-1] - 2 * MOVE)
    batch = torch.cat([capture, capture.flip(-1) / 2])
    return {
        "mirror": difference(mirrored(capture.flip(-1)).flip(-1), picture),
        "move": difference(reconstruct(moved)[..., back, back], picture[..., inner, inner]),
        "batch": difference(reconstruct(batch)[:1], picture),
    }


def measure(methods, size, count):
    rows = []
    for method in methods:
        for kind, part in PARTS.items():
            generator = torch.Generator().manual_seed(29)
            results = [changes(method, *captures(size, part, generator)) for _ in range(count)]
            row = {name: fmean(each[name] for each in results) for name in results[0]}
            rows.append({"method": method, "captures": kind, "size": size, "count": count, **row})
            print(f"| {method} | {kind} | " + " | ".join(f"{value:.1e}" for value in row.values()) + " |", flush=True)
    return rows


def rows_of_pairs(data, count, psfs):
    """Name, camera, pairs and variant of the score of each row."""
    recipe, photographs = read_recipe("mismatched"), Photographs(data / "photos" / "test")
    for name in psfs or universal.PSFS:
        camera = universal.camera(data, name)
        for full_well, exact in ((15_000.0, True), (2_000.0, False)):
            made = universal.captures(camera.psf, photographs, recipe, full_well, range(count), exact=exact)
            yield f"{name}, {full_well:,.0f} e, {'exact' if exact else 'mismatched'}", camera, made, "clipped"
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "pairs.h5"
        import_pairs("diffusercam", data / "diffusercam", file)
        yield "DiffuserCam, real", universal.camera(data, "DiffuserCam 270x480"), PairFile(file), "best-gain"


def gains(methods, data, count, psfs):
    rows = []
    for name, camera, pairs, variant in rows_of_pairs(data, count, psfs):
        for method in methods:
            bound = {str(each): Reconstructor(method, camera, ensemble=each) for each in (False, True)}
            scores = evaluate(bound, pairs, FULL, variant=variant, perceptual=NONE).methods
            plain, averaged = (scores[str(each)].values["psnr"] for each in (False, True))
            mean, low, high = bootstrap([b - a for a, b in zip(plain, averaged, strict=True)])
            row = {"row": name, "method": method, "count": len(plain), "psnr": fmean(plain)}
            rows.append(row | {"gain": mean, "low": low, "high": high})
            print(f"| {name} | {method} | {fmean(plain):.2f} | {mean:+.2f} ({low:+.2f} to {high:+.2f}) |", flush=True)
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gain", type=Path, metavar="DATA")
    parser.add_argument("--size", type=int, default=63)
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--methods", nargs="+")
    parser.add_argument("--psfs", nargs="+", help="rows of these PSFs and the real pairs; all unless given")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    if arguments.gain:
        rows = gains(
            arguments.methods or ["universal-small", "universal"], arguments.gain, arguments.count, arguments.psfs
        )
    else:
        rows = measure(arguments.methods or METHODS, arguments.size, arguments.count)
    if arguments.out:
        with atomic(arguments.out) as temporary:
            temporary.write_text("[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n")


if __name__ == "__main__":
    main()
