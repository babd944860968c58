"""Pictures of a benchmark's page: reconstructions side by side, training curves, robustness."""

import io
import math
import statistics
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.benchmark.pages import Picture
from mwdn.benchmark.recipe import SWEPT
from mwdn.benchmark.robustness import Sweep
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.images import srgb_encode

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEIGHT = 160
"""Height in pixels of each picture in a grid."""

LABELS = {
    "noise": "noise / noise in training",
    "shift_px": "shift of the PSF / px along each axis",
    "turn_degrees": "rotation of the PSF / degrees",
    "scale": "magnification of the PSF",
    "haze": "haze / light of the PSF",
    "off_axis": "off-axis variation (1: in front of a display)",
}

Row = tuple[list[str], Tensor]
"""Titles and pictures of a row; pictures are (N, C, H, W) in linear light."""


def grid(name: str, rows: list[Row], words: str) -> Picture:
    """Arrange rows of pictures under their titles; more than six rows take two columns.

    Args:
        name: file name of the result.
        rows: with the same number of pictures; each picture is scaled to its own brightest pixels.
        words: description of the result.
    """
    strips = [contact_sheet([list(torch.split(pictures, 1))], titles, height=HEIGHT) for titles, pictures in rows]
    widest = max(strip.shape[-1] for strip in strips)
    strips = [F.pad(strip, (0, widest - strip.shape[-1]), value=1.0) for strip in strips]
    half = math.ceil(len(strips) / 2) if len(strips) > 6 else len(strips)
    columns = [torch.cat(strips[i : i + half], dim=-2) for i in range(0, len(strips), half)]
    tallest = max(column.shape[-2] for column in columns)
    columns = [F.pad(column, (0, 12, 0, tallest - column.shape[-2]), value=1.0) for column in columns]
    return Picture(name, _jpeg(torch.cat(columns, dim=-1)), words)


def _jpeg(image: Tensor) -> bytes:
    frame = (255 * srgb_encode(image[0])).round().movedim(0, -1).numpy().astype(np.uint8)
    data = cv2.imencode(".jpg", np.ascontiguousarray(frame[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
    return data.tobytes()


def curves(name: str, runs: dict[str, tuple[list[tuple[int, float]], list[tuple[int, float]]]], words: str) -> Picture:
    """Plot the loss and the validation PSNR of every network against the step.

    Args:
        name: file name of the result.
        runs: of each network its losses and its PSNRs, as pairs of step and value.
        words: description of the result.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.2), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, (label, (losses, psnrs)) in enumerate(runs.items()):
        style: dict[str, Any] = {"color": f"C{number % 10}", "ls": ("-", "--")[number // 10 % 2], "lw": 1.2}
        left.semilogy([step for step, _ in losses], _smooth([loss for _, loss in losses]), **style)
        right.plot(*zip(*psnrs, strict=True), label=label, marker=".", **style)
    left.set(xlabel="step", ylabel="training loss, running mean")
    right.set(xlabel="step", ylabel="validation PSNR / dB")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    return Picture(name, _png(figure), words)


def _smooth(values: list[float]) -> list[float]:
    """Running mean over the last twentieth of all values."""
    window = max(1, len(values) // 20)
    return [statistics.fmean(values[max(0, i + 1 - window) : i + 1]) for i in range(len(values))]


def robustness(label: str, sweeps: dict[str, Sweep]) -> Picture:
    """Plot the PSNR of one method against the size of every mismatch, with the other methods in grey.

    Args:
        label: of the method.
        sweeps: of all methods, by label.
    """
    from matplotlib.figure import Figure

    mismatches = list(sweeps[label])
    figure = Figure(figsize=(2.6 * len(mismatches) + 0.6, 2.7), dpi=100, layout="constrained")
    panels = figure.subplots(1, len(mismatches), sharey=True, squeeze=False)[0]
    for panel, axis in zip(panels, mismatches, strict=True):
        for other, sweep in sweeps.items():
            if other != label:
                _plot(panel, sweep[axis], color="0.82", lw=0.8)
        _plot(panel, sweeps[label][axis], color="C0", marker="o", ms=3, zorder=3)
        if axis == "noise":
            panel.set_xscale("log", base=2)
        panel.set_xlabel(LABELS[axis], fontsize=8)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.3)
        panel.axvline(SWEPT[axis], color="k", lw=0.5)
    panels[0].set_ylabel("PSNR / dB", fontsize=8)
    figure.suptitle(label, fontsize=10)
    words = f"{label}: PSNR against the size of each mismatch; other methods in grey"
    return Picture(f"robustness-{label}.png", _png(figure), words)


def _plot(panel: "Axes", psnr: dict[float, list[float]], **style: Any) -> None:  # noqa: ANN401
    panel.plot(list(psnr), [statistics.fmean(values) for values in psnr.values()], **style)


def _png(figure: "Figure") -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return data.getvalue()
