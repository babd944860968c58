"""The picture of the start page: a lensless camera, its PSF, a scene, its capture and its reconstruction.

    python docs/explain.py [docs/explain.webp]

The camera is that of `mwdn demo`; everything is simulated but the photograph.
"""

import sys
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mwdn import Calibration, Camera, Reconstructor, to_display
from mwdn.cli.demo import MASK, SETUP
from mwdn.io.files import atomic
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics.design import design_camera

matplotlib.use("agg")
GROUND, INK, FAINT, LIGHT = "#14181d", "#e8ecf0", "#8fa1b3", ("#ffb454", "#59c2b4", "#e07a6a")


def show(axes: Axes, light: torch.Tensor, title: str) -> None:
    """A picture in linear light, (1, 3, H, W), under its title."""
    axes.imshow(srgb_encode(to_display(light))[0].movedim(0, -1).numpy())
    axes.set_title(title, color=INK, fontsize=13, pad=7)
    axes.axis("off")


def draw_camera(axes: Axes) -> None:
    """Rays of three points of a scene through a mask: each casts the same pattern, displaced."""
    axes.set(xlim=(0, 10), ylim=(-2.6, 3.4), aspect="auto")
    axes.axis("off")
    axes.set_title("A camera without a lens: a mask in front of a sensor", color=INK, fontsize=13, pad=7)
    generator = np.random.default_rng(3)
    rows = np.sort(generator.uniform(-0.8, 0.8, 6))
    bend = generator.uniform(-0.22, 0.22, 6)
    for height, colour in zip((1.6, 0.0, -1.6), LIGHT, strict=True):
        axes.plot(0.7, height, "o", color=colour, markersize=9)
        for row, turn in zip(rows, bend, strict=True):
            # The mask bends each ray by its own angle, whatever the ray's direction.
            slope = (row - height) / (7.2 - 0.7) + turn
            end = row + slope * (9.3 - 7.2)
            axes.plot([0.7, 7.2, 9.3], [height, row, end], color=colour, linewidth=1, alpha=0.55)
            axes.plot(9.36, end, "s", color=colour, markersize=4)
    wave = np.linspace(-1.1, 1.1, 200)
    axes.plot(7.2 + 0.09 * np.sign(np.sin(9 * wave)), wave, color=INK, linewidth=2)
    axes.plot([9.45, 9.45], [-2.1, 2.1], color=INK, linewidth=4)
    for x, text in ((0.7, "points of\na scene"), (7.2, "mask"), (9.3, "sensor")):
        axes.text(x, 2.35, text, color=FAINT, ha="center", va="bottom", fontsize=11)


def main(out: Path = Path("docs/explain.webp")) -> None:
    """Simulate, reconstruct and draw."""
    camera = Camera(design_camera("contour", MASK, SETUP).psf)
    scene = dark_scene("coffee", SETUP.size, side=200)
    measurement = camera.simulate(scene, generator=torch.Generator().manual_seed(0))
    picture = Reconstructor("universal", Calibration(camera.psf), device="cpu")(measurement)
    figure = Figure(figsize=(10.5, 7.3), facecolor=GROUND)
    grid = figure.add_gridspec(2, 3, left=0.015, right=0.985, top=0.945, bottom=0.015, hspace=0.13, wspace=0.04)
    draw_camera(figure.add_subplot(grid[0, :2]))
    show(figure.add_subplot(grid[0, 2]), camera.psf, "What one point casts: the PSF")
    show(figure.add_subplot(grid[1, 0]), scene, "A scene")
    show(figure.add_subplot(grid[1, 1]), measurement, "What the sensor records")
    show(figure.add_subplot(grid[1, 2]), picture, "Reconstructed by mwdn")
    written = BytesIO()
    figure.savefig(written, format="webp", dpi=110, facecolor=GROUND, pil_kwargs={"quality": 82, "method": 6})
    with atomic(out) as temporary:
        temporary.write_bytes(written.getvalue())


if __name__ == "__main__":
    with torch.inference_mode():
        main(*map(Path, sys.argv[1:]))
