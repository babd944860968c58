"""Light where there is none: how errors of PSF and capture make blobs, and whether the map of support shows them.

    python benchmarks/blobs.py ../shared/data [--methods universal universal-small admm]

A disc with a photograph in dark surroundings is simulated through the paper's PSF at 160 x 160 pixels, with one error
at a time. For each method: the part of the picture's light outside the object, and the rank correlation of each part's
support with its negative relative error (mean over the scenes). Prints a table and writes it as JSON.
"""

import argparse
import json
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn import Calibration, Camera, Reconstructor, Sensor
from mwdn.diagnosis.support_map import support_map
from mwdn.io.files import atomic
from mwdn.io.images import read_picture, srgb_encode
from mwdn.optics import sample_camera
from mwdn.optics.deviation import Deviation
from mwdn.optics.field import gaussian_blur
from mwdn.optics.warp import hazed
from mwdn.solvers import align

SIZE, DIAMETER = 160, 64


def disc(name: str) -> Tensor:
    """A round photograph in the middle of a dark field, (1, 3, SIZE, SIZE)."""
    picture = read_picture(str(files("mwdn") / "io" / "pictures" / f"{name}.jpg"))
    place = torch.linspace(-1, 1, DIAMETER)
    inside = place[:, None] ** 2 + place**2 <= 1
    return F.pad(F.interpolate(picture, (DIAMETER, DIAMETER), mode="area") * inside, ((SIZE - DIAMETER) // 2,) * 4)


def expose(light: Tensor, full_well: float = 15_000.0) -> Tensor:
    """A capture with its brightest pixel at 90 % of the full scale."""
    return Sensor(full_well=full_well).expose(0.9 * light / light.amax(), generator=torch.Generator().manual_seed(1))


def grainy(psf: Tensor) -> Tensor:
    """Relative errors of 10 % in single pixels."""
    return psf * (1 + 0.1 * torch.randn(psf.shape, generator=torch.Generator().manual_seed(2))).clamp(min=0)


def beyond(scene: Tensor) -> Tensor:
    """The scene, and an object of its brightness just beyond its left edge, on a wider field."""
    wide = F.pad(scene, (SIZE // 2,) * 4)
    wide[..., SIZE : SIZE + 40, SIZE // 2 - 45 : SIZE // 2 - 5] = scene.amax()
    return wide


ERRORS: dict[str, Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    "none": lambda psf, scene: (expose(Camera(psf)(scene)), psf),
    "noise: 400 electrons at the brightest pixel": lambda psf, scene: (expose(Camera(psf)(scene), 400 / 0.9), psf),
    "PSF turned by 0.5 degrees": lambda psf, scene: (
        expose(Deviation(turn_degrees=0.5).camera(psf).forward(scene)),
        psf,
    ),
    "PSF scaled by 1 %": lambda psf, scene: (expose(Deviation(scale=0.01).camera(psf).forward(scene)), psf),
    "PSF blurred by half a pixel": lambda psf, scene: (
        expose(Camera(gaussian_blur(psf, 0.5).clamp(min=0))(scene)),
        psf,
    ),
    "PSF with 10 % of grain": lambda psf, scene: (expose(Camera(psf)(scene)), grainy(psf)),
    "PSF changes over the field": lambda psf, scene: (expose(Deviation(off_axis=1).camera(psf).forward(scene)), psf),
    "15 % of haze that the PSF lacks": lambda psf, scene: (expose(Camera(hazed(psf, 0.15))(scene)), psf),
    "5 % of its peak subtracted from the PSF": lambda psf, scene: (
        expose(Camera(psf)(scene)),
        (psf - 0.05 * psf.amax()).clamp(min=0),
    ),
    "ambient light, 20 % of the mean": lambda psf, scene: (
        expose((light := Camera(psf)(scene)) + 0.2 * light.mean()),
        psf,
    ),
    "an object beyond the edge": lambda psf, scene: (expose(Camera(psf, size=(SIZE, SIZE))(beyond(scene))), psf),
    "gamma-coded capture": lambda psf, scene: (srgb_encode(expose(Camera(psf)(scene)).clamp(0, 1)), psf),
    "another camera's PSF": lambda psf, scene: (
        expose(Camera(psf)(scene)),
        sample_camera(3, (SIZE, SIZE), family="contours"),
    ),
}
"""Capture and calibrated PSF for each error, given the true PSF and the scene."""


def rank_correlation(first: Tensor, second: Tensor) -> float:
    """Spearman's correlation of two lists of numbers."""
    return torch.corrcoef(torch.stack([x.argsort().argsort().float() for x in (first, second)]))[0, 1].item()


def measure(method: str, capture: Tensor, psf: Tensor, scene: Tensor) -> tuple[float, float]:
    """Part of the light outside the object, and the rank correlation of support and negative error."""
    picture = Reconstructor(method, Calibration(psf), device="cpu")(capture).clamp(min=0)
    place = torch.arange(SIZE) - (SIZE - 1) / 2
    dark = (place[:, None] ** 2 + place**2).sqrt() > DIAMETER / 2 + 2
    outside = (picture * dark).sum() / picture.sum()
    support = support_map(capture, align(capture, psf).move(psf), picture).map
    picture = picture * (picture * scene).sum() / picture.square().sum()
    power, error = (
        F.adaptive_avg_pool2d(x.square().mean(1, keepdim=True), tuple(support.shape))[0, 0]
        for x in (picture, picture - scene)
    )
    lit = power > 1e-4 * power.amax()
    return outside.item(), rank_correlation(support[lit], -(error / power)[lit])


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--methods", nargs="+", default=["universal", "universal-small", "admm"])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/blobs.json"))
    arguments = parser.parse_args()
    psf = Calibration.from_file(arguments.data / "mwdn-camera" / "psf_320.png", bin=2).psf
    scenes = [disc("astronaut"), disc("coffee")]
    rows: dict[str, dict[str, list[float]]] = {}
    for name, error in ERRORS.items():
        rows[name] = {}
        for method in arguments.methods:
            scores = torch.tensor([measure(method, *error(psf, scene), scene) for scene in scenes]).mean(0)
            rows[name][method] = scores.tolist()
        cells = [f"{outside:.1%}, {rank:.2f}" for outside, rank in rows[name].values()]
        print("|", " | ".join([name, *cells]), "|", flush=True)
    with atomic(arguments.out) as temporary:
        temporary.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    with torch.inference_mode():
        main()
