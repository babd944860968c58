"""The report of a PSF as one page of plots, drawn by matplotlib."""

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mwdn.calibration.report import PsfReport
from mwdn.calibration.verdict import headline, verdict
from mwdn.io.files import atomic_write
from mwdn.io.images import srgb_encode
from mwdn.optics import psf_measures, psf_spectrum
from mwdn.types import Psf

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"bad": "#b00020", "weak": "#b36b00", "good": "#1b7837"}
_MARKS = {"bad": "!!", "weak": "!", "good": "+"}


def draw_page(report: PsfReport, psf: Psf, title: str) -> "Figure":
    """Draw the PSF, its autocorrelation, its spectrum, noise gain and resolution over the verdict."""
    from matplotlib.figure import Figure

    # Without pyplot, which needs a display and keeps figures open.
    figure = Figure(figsize=(11.7, 11.7), dpi=110, layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.15, 1))[:, 0]
    above.suptitle(f"{title}   {report.size[0]} x {report.size[1]}   PSF {report.psf_hash}", fontsize=12)
    axes = above.subplots(2, 3)
    _draw_psf(axes[0, 0], psf)
    _draw_autocorrelation(axes[0, 1], psf)
    _draw_profile(axes[0, 2], psf)
    _draw_spectrum(axes[1, 0], psf, report)
    _draw_gain(axes[1, 1], report)
    _draw_resolution(axes[1, 2], psf, report)
    _write_verdict(below, report)
    return figure


def write_page(path: Path, report: PsfReport, psf: Psf, title: str) -> None:
    """Write the page as PNG, atomically.

    Raises:
        ImageError: the file cannot be written.
    """
    figure = draw_page(report, psf, title)
    with atomic_write(path) as temporary:
        figure.savefig(temporary)


def _draw_psf(axes: "Axes", psf: Psf) -> None:
    bright = psf.flatten(1).sort().values[0, int(0.998 * (psf.numel() - 1))].clamp(min=1e-30)
    picture = srgb_encode(psf[0] / bright).movedim(0, -1).cpu().numpy()
    axes.imshow(picture if picture.shape[-1] == 3 else picture[..., 0], cmap="gray", vmin=0, vmax=1)
    axes.set_title("PSF (sRGB)", fontsize=10)


def _draw_autocorrelation(axes: "Axes", psf: Psf) -> None:
    image = psf_measures.autocorrelation(psf).image.numpy()
    height, width = image.shape
    extent = (-(width // 2) - 0.5, width - width // 2 - 0.5, height - height // 2 - 0.5, -(height // 2) - 0.5)
    shown = axes.imshow(image, cmap="RdBu_r", vmin=-0.3, vmax=0.3, extent=extent)
    axes.figure.colorbar(shown, ax=axes, shrink=0.7)
    axes.set_title("autocorrelation of the detail", fontsize=10)


def _draw_profile(axes: "Axes", psf: Psf) -> None:
    image = psf_measures.autocorrelation(psf).image.numpy()
    row, column = image.shape[0] // 2, image.shape[1] // 2
    reach = min(row, column, 40)
    steps = np.arange(-reach, reach + 1)
    steps = steps[(steps + row < image.shape[0]) & (steps + column < image.shape[1])]
    axes.plot(steps, image[row + steps, column], label="vertical")
    axes.plot(steps, image[row, column + steps], label="horizontal")
    axes.set(xlabel="displacement / px", ylim=(-0.35, 1.05))
    axes.set_title("autocorrelation through its peak", fontsize=10)
    axes.legend(fontsize=8)


def _draw_spectrum(axes: "Axes", psf: Psf, report: PsfReport) -> None:
    for channel, colour in zip(range(psf.shape[1]), ("C3", "C2", "C0") if psf.shape[1] == 3 else ("k",), strict=True):
        frequency, power = psf_spectrum.radial_power(psf[:, [channel]])
        axes.plot(frequency[1:], 10 * power[1:].clamp(min=1e-12).log10(), colour, lw=1)
    for ring in report.dark_rings:
        axes.axvline(ring, color=_COLOURS["weak"], lw=0.7)
    if report.levels and report.levels.noise_floor > 0:
        axes.axhline(10 * np.log10(report.levels.noise_floor), color="grey", ls=":", label="noise of the file")
        axes.legend(fontsize=8)
    axes.set(xlabel="frequency / (cycles / px)", ylabel="|H|^2 / dB", xlim=(0, 0.5))
    axes.set_title("spectrum, mean over rings", fontsize=10)


def _draw_gain(axes: "Axes", report: PsfReport) -> None:
    values = list(report.noise_gain)
    axes.loglog(values, [gain**0.5 for gain in report.noise_gain.values()], "C1o-", label="noise, standard deviation")
    axes.loglog(values, list(report.detail_kept.values()), "C4s-", label="fraction of the detail kept")
    axes.set(xlabel="lambda")
    axes.set_title("Wiener estimate", fontsize=10)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def _draw_resolution(axes: "Axes", psf: Psf, report: PsfReport) -> None:
    noises = np.logspace(-4, -1.5, 16)
    frequency = [
        min(psf_spectrum.resolved_frequency(psf[:, [c]], float(noise)) for c in range(psf.shape[1])) for noise in noises
    ]
    pairs = [(100 * noise, 0.5 / f) for noise, f in zip(noises, frequency, strict=True) if f > 0]
    if pairs:
        axes.loglog(*zip(*pairs, strict=True), "C2-")
    reported = [(100 * noise, width) for noise, width in report.resolution_px.items() if width < float("inf")]
    if reported:
        axes.loglog(*zip(*reported, strict=True), "C2o")
    axes.set(xlabel="noise of the measurement / % of its mean", ylabel="finest lines / px")
    axes.set_title("expected resolution", fontsize=10)
    axes.grid(alpha=0.3, which="both")


def _write_verdict(part: "Figure", report: PsfReport) -> None:  # a SubFigure, which has the same methods
    part.text(0.02, 0.96, headline(report), fontsize=13, weight="bold", va="top")
    top = 0.885
    for weight, text in verdict(report):
        lines = textwrap.wrap(text, 150)
        part.text(0.02, top, _MARKS[weight], fontsize=9.5, weight="bold", color=_COLOURS[weight], va="top")
        part.text(0.045, top, "\n".join(lines), fontsize=9.5, color=_COLOURS[weight], va="top")
        top -= 0.037 * len(lines) + 0.018
