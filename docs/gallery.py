"""Write docs/masks.md and its pictures, and compare the designed PSF of the paper's camera with the measured one.

    python docs/gallery.py

The measured PSF is read from MWDN_DATA or ../shared/data. Its curves go into docs/paper-camera.jpg. Its picture goes
only into results/gallery/, which git ignores.
"""

import os
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional as F

from mwdn import Calibration, Camera, Reconstructor, read_picture, write_picture
from mwdn.evaluation import psnr
from mwdn.io.contact_sheets import contact_sheet, to_display
from mwdn.io.files import atomic, write_text
from mwdn.io.images import srgb_encode
from mwdn.optics import CodedAperture, Contour, Diffuser, Lenslets, Mask, Pinholes, Setup, ZoneAperture, mask_psf
from mwdn.optics.design import Designed, design_camera
from mwdn.optics.psf_measures import autocorrelation_width, radial_autocorrelation
from mwdn.optics.psf_spectrum import radial_spectrum
from mwdn.types import Psf, Scene

DOCS = Path(__file__).resolve().parent
RESULTS = DOCS.parent / "results" / "gallery"
PAPER = Setup(wavelengths=13)

CAMERAS = {
    "contour": (Contour(size_mm=(3.2, 2.8)), PAPER),
    "diffuser": (Diffuser(), PAPER),
    "lenslets": (Lenslets(), PAPER),
    "zone": (ZoneAperture(), replace(PAPER, distance_mm=1.0)),
    "coded": (CodedAperture(), replace(PAPER, distance_mm=0.5, aperture_mm=(2.6, 2.6))),
    "pinholes": (Pinholes(), PAPER),
}
"""All on the paper's sensor behind its aperture, nearer where diffraction would blur the shadow. The contour mask is
the open part of the paper's mask, at every 30 nm of the band: a minute instead of three."""

ROWS = re.compile(r"(?<=\| --- \|\n)\| contour \|.*?(?=\n\n- \*Light)", re.DOTALL)
"""Rows of the first table of docs/masks.md."""


def scene() -> Scene:
    """The cup of coffee in the centre of a dark field."""
    picture = read_picture(str(files("mwdn") / "io" / "pictures" / "coffee.jpg"))
    return F.pad(picture, ((PAPER.size[0] - picture.shape[-1]) // 2,) * 4)


def captured(designed: Designed) -> tuple[list[torch.Tensor], float, list[float]]:
    """One row of the sheet, the exposure, and the PSNR of each method."""
    truth, psf = scene(), designed.psf
    gain = 0.9 / Camera(psf).forward(truth).max().item()
    measurement = Camera(psf * gain).simulate(truth, generator=torch.Generator().manual_seed(0))
    results = [Reconstructor(name, Calibration(psf), device="cpu")(measurement) / gain for name in ("wiener", "admm")]
    scores = [psnr(result.clamp(0, 1), truth).item() for result in results]
    exposure = gain / designed.light.sum((-2, -1)).mean().item()
    return [*designed.pictures(), measurement, *(result.clamp(0, 1) for result in results)], exposure, scores


def write_jpeg(path: Path, picture: torch.Tensor, quality: int = 82) -> None:
    """Write linear light as an sRGB JPEG."""
    pixels = (srgb_encode(picture[0]).movedim(0, -1).numpy() * 255).round().astype(np.uint8)
    encoded, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not encoded:
        raise OSError(f"OpenCV cannot encode {path}")
    with atomic(path) as temporary:
        temporary.write_bytes(data.tobytes())


def plot(curves: dict[str, np.ndarray], title: str, ends: tuple[float, float], log: bool) -> np.ndarray:
    """Plot curves with even spacing, 420 x 320 pixels of uint8; ``ends`` label the horizontal axis."""
    height, width, left, low, up = 320, 420, 56, 34, 26
    canvas = np.full((height, width, 3), 255, np.uint8)
    lowest, highest = (-3.0, 0.0) if log else (-0.1, 1.0)

    def place(x: float, y: float) -> tuple[int, int]:
        part = (np.clip(y, lowest, highest) - lowest) / (highest - lowest)
        return round(left + x * (width - left - 12)), round(height - low - part * (height - low - up))

    def write(text: str, at: tuple[int, int], colour: tuple[int, int, int] = (60, 60, 60)) -> None:
        cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)

    for value in (-3, -2, -1, 0) if log else (0.0, 0.25, 0.5, 0.75, 1.0):
        cv2.line(canvas, place(0, value), place(1, value), (225, 225, 225), 1)
        write(f"{10.0**value:g}" if log else f"{value:g}", (6, place(0, value)[1] + 4))
    for part in (0, 0.25, 0.5, 0.75, 1):
        write(f"{ends[0] + part * (ends[1] - ends[0]):g}", (place(part, lowest)[0] - 10, height - 16))
    colours = [(200, 80, 20), (30, 120, 220), (120, 120, 120)]
    for row, ((name, values), colour) in enumerate(zip(curves.items(), colours, strict=False)):
        values = np.log10(np.maximum(values, 1e-6)) if log else values
        points = [place(i / (len(values) - 1), float(value)) for i, value in enumerate(values)]
        cv2.polylines(canvas, [np.array(points, np.int32)], False, colour, 2, cv2.LINE_AA)
        write(name, (width - 190, up + 20 + 18 * row), colour)
    write(title, (left, 16))
    return canvas


def hazy(psf: Psf, fraction: float) -> Psf:
    """A PSF with a fraction of the light undeflected, in the shadow of the aperture."""
    plate = Mask("phase", torch.zeros(1600, 1400), 2.0, 1.46)
    shadow = mask_psf(plate, replace(PAPER, wavelengths=3, colour=False))
    return (1 - fraction) * psf + fraction * shadow / shadow.sum()


def compare(designed: Psf, measured: Psf) -> None:
    """Draw docs/paper-camera.jpg (designed PSF, curves of both) and results/gallery/psf.png (both PSFs)."""
    ratio = np.median((radial_spectrum(designed) / radial_spectrum(measured)).numpy()[6:])
    haze = 1 - 1 / ratio
    both = {"designed": designed, "measured": measured, f"designed, {haze:.0%} haze": hazy(designed, haze)}
    spectra = {name: radial_spectrum(psf).numpy() for name, psf in both.items()}
    correlations = {name: radial_autocorrelation(psf, 31).numpy() for name, psf in both.items()}
    for name, psf in both.items():
        ratios = spectra[name][6:] / spectra["measured"][6:]
        error = abs(correlations[name] - correlations["measured"]).max()
        width = autocorrelation_width(psf)
        print(f"{name}: autocorrelation {width:.2f} px wide, at most {error:.2f} from the measured one;")
        print(
            f"  ring at {spectra[name][6:].argmax() + 6} / 120; "
            f"spectrum {ratios.min():.2f} to {ratios.max():.2f} of measured"
        )
    picture = (srgb_encode(to_display(designed)[0]).movedim(0, -1).numpy() * 255).round().astype(np.uint8)
    sheet = np.concatenate(
        [
            picture[..., ::-1],
            plot(spectra, "modulus of the transfer function / cycles per pixel", (0, 0.5), log=True),
            plot(correlations, "autocorrelation / pixels of 9.6 um", (0, 30), log=False),
        ],
        axis=1,
    )
    if not cv2.imwrite(str(DOCS / "paper-camera.jpg"), sheet, [cv2.IMWRITE_JPEG_QUALITY, 88]):
        raise OSError("docs/paper-camera.jpg cannot be written")
    write_picture(RESULTS / "psf.png", contact_sheet([[designed, measured]], ["designed", "measured"], height=320))


def main() -> None:
    """Write the page, its pictures and the comparison; print the table."""
    rows, table, contour, contour_exposure = [], [], None, 1.0
    for name, (mask, setup) in CAMERAS.items():
        designed = design_camera(name, mask, setup)
        row, exposure, scores = captured(designed)
        rows.append(row)
        if name == "contour":
            contour, contour_exposure = designed, exposure
        made = designed.report()["made"]
        light = sum(made["light_on_sensor"]) / len(made["light_on_sensor"])
        table.append(
            f"| {name} | {setup.distance_mm:g} mm | {light:.1%} | {exposure / contour_exposure:.2g} | "
            f"{made['resolution_mrad']:.0f} mrad | {scores[0]:.1f} | {scores[1]:.1f} |"
        )
        print(table[-1], flush=True)
    titles = ["mask (middle)", "PSF", "spectrum (3 decades)", "measurement", "Wiener", "ADMM"]
    write_jpeg(DOCS / "masks.jpg", contact_sheet(rows, titles))
    page = (DOCS / "masks.md").read_text(encoding="utf-8")
    write_text(DOCS / "masks.md", ROWS.sub(lambda _: "\n".join(table), page, count=1))
    data = Path(os.environ.get("MWDN_DATA", DOCS.parents[1] / "shared" / "data"))
    measured = data / "mwdn-camera" / "psf_320.png"
    if measured.is_file() and contour is not None:
        compare(contour.psf, Calibration.from_file(measured).psf)
    else:
        print(f"docs/paper-camera.jpg is unchanged: no measured PSF at {measured}. Set MWDN_DATA.")


if __name__ == "__main__":
    main()
