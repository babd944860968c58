"""`mwdn demo`: a simulated camera, its captures, and five methods that need no training."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from cyclopts import Parameter
from rich.table import Table

from mwdn.calibration import Calibration
from mwdn.cli.terminal import console, quoted, say
from mwdn.evaluation import psnr
from mwdn.evaluation.tables import html_table
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import contact_sheet, to_display
from mwdn.io.files import check_folder, refuse_foreign, write_text
from mwdn.io.images import write_frame, write_linear, write_picture
from mwdn.io.pictures import PICTURES, Picture, dark_scene
from mwdn.optics import Camera, Contour, Sensor, Setup
from mwdn.optics.design import design_camera

SETUP = Setup(wavelengths=9)
"""The paper's camera at fewer wavelengths."""

SENSOR = Sensor(full_well=60_000.0)
"""Four frames of the paper's sensor, averaged."""

MASK = Contour(size_mm=(3.0, 2.5), pitch_um=4.0)
"""The open part of the paper's mask, with squares twice as large: takes a second to simulate."""

EXPOSED_PEAK = 0.9
"""Light of the brightest pixel over saturation, as a well exposed capture has it."""

DEMO_FILES = ("index.html", "comparison.png", "pattern.png", "psf.tif", *(f"captures/{name}.png" for name in PICTURES))
DEMO_METHODS = ("universal", "pyramid", "admm", "fista", "wiener")


def demo(
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/demo"),
    seed: int = 0,
    pictures: Annotated[tuple[Picture, ...], Parameter(consume_multiple=True, negative=())] = PICTURES,
) -> None:
    """Simulate a small lensless camera and reconstruct its captures with five methods that need no training.

    Args:
        out: folder for the page, its pictures, and the camera's own files: psf.tif and captures/.
        seed: of the camera's mask and of its noise.
        pictures: names of the scenes.
    """
    refuse_foreign(out, DEMO_FILES, b"mwdn demo")
    check_folder(out)
    generator = torch.Generator().manual_seed(seed)
    camera = Camera(design_camera("contour", replace(MASK, seed=seed), SETUP).psf, sensor=SENSOR)
    calibration = Calibration(camera.psf)
    reconstructors = {name: Reconstructor(name, calibration, device="cpu") for name in DEMO_METHODS}
    table = Table("picture", title="PSNR in dB")
    for name in DEMO_METHODS:
        table.add_column(name, justify="right")
    rows, captures = [], {}
    for name in pictures:
        scene = dark_scene(name, SETUP.size, side=200)
        light = camera(scene)
        exposure = EXPOSED_PEAK / light.max()
        measurement = camera.sensor.expose(exposure * light, generator=generator)
        results = [reconstruct(measurement) / exposure for reconstruct in reconstructors.values()]
        table.add_row(name, *(f"{psnr(result.clamp(0, 1), scene).item():.2f}" for result in results))
        rows.append([scene, measurement, *results])
        captures[name] = (65535 * measurement.clamp(0, 1)).round()[0].movedim(0, -1).numpy().astype(np.uint16)
    page, comparison, pattern, psf = (out / name for name in DEMO_FILES[:4])
    write_text(page, _PAGE.format(table=html_table(table)))
    write_picture(comparison, contact_sheet(rows, ["scene", "measurement", *DEMO_METHODS]))
    write_picture(pattern, to_display(camera.psf))
    write_linear(psf, camera.psf / camera.psf.max())
    for name, frame in captures.items():
        write_frame(out / "captures" / f"{name}.png", frame)
    console.print(table)
    say(f"Look at {page}", f"Go on: mwdn reconstruct {quoted(out / 'captures')} --psf {quoted(psf)} --background 0")


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>mwdn demo</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 78rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
img {{ max-width: 100%; }} td, th {{ padding: .2rem 1rem; text-align: right; }} th:first-child {{ text-align: left; }}
</style>
<h1>Lensless imaging</h1>
<p>A camera without a lens: a thin mask in front of the sensor turns each point of the scene into the pattern
below, the point spread function, computed here from a mask of eight levels by diffraction. The sensor records
the scene convolved with it.</p>
<img src="pattern.png" alt="point spread function" width="320">
<p>The methods below needed no training for this camera: <em>universal</em> is a network that comes with the
package and was trained on thousands of random cameras; the others are classical.</p>
<img src="comparison.png" alt="scene, measurement and reconstructions">
{table}
</html>
"""
