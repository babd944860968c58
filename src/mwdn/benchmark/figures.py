"""The pictures of a benchmark's page: reconstructions side by side, training curves, robustness."""

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
from mwdn.benchmark.recipe import AXES
from mwdn.benchmark.robustness import Sweep
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.images import srgb_encode

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEIGHT = 160
"""Pixels of each picture of a grid."""

LABELS = {
    "noise": "noise / that of the training",
    "shift_px": "shift of the PSF / px along each axis",
    "turn_degrees": "rotation of the PSF / degrees",
    "scale": "magnification of the PSF",
    "background": "background / light of the PSF",
    "off_axis": "off-axis variation (1: as before a display)",
}

Line = tuple[list[str], Tensor]
"""Titles of pictures, and the pictures, (N, C, H, W) in linear light."""


def grid(name: str, lines: list[Line], words: str) -> Picture:
    """Arrange lines of pictures, each under its titles; in two columns if there are many.

    Args:
        name: of the picture's file.
        lines: as many pictures each; scaled for people one by one.
        words: what is shown.
    """
    strips = [contact_sheet([[one[None] for one in pictures]], titles, height=HEIGHT) for titles, pictures in lines]
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
    """Draw the loss and the validation PSNR of every network over the steps.

    Args:
        name: of the picture's file.
        runs: loss by step, and PSNR by step, of each network.
        words: what is shown.
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
    """Mean of each value and those before it, over a twentieth of all."""
    reach = max(1, len(values) // 20)
    return [statistics.fmean(values[max(0, i + 1 - reach) : i + 1]) for i in range(len(values))]


def robustness(label: str, sweeps: dict[str, Sweep]) -> Picture:
    """Draw PSNR of one method over every mismatch, with the others in grey.

    Args:
        label: of the method.
        sweeps: of all methods.
    """
    from matplotlib.figure import Figure

    axes_names = list(sweeps[label])
    figure = Figure(figsize=(2.6 * len(axes_names) + 0.6, 2.7), dpi=100, layout="constrained")
    panels = figure.subplots(1, len(axes_names), sharey=True, squeeze=False)[0]
    for panel, axis in zip(panels, axes_names, strict=True):
        for other, sweep in sweeps.items():
            if other != label:
                _draw(panel, sweep[axis], color="0.82", lw=0.8)
        _draw(panel, sweeps[label][axis], color="C0", marker="o", ms=3, zorder=3)
        if axis == "noise":
            panel.set_xscale("log", base=2)
        panel.set_xlabel(LABELS[axis], fontsize=8)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.3)
        panel.axvline(AXES[axis], color="k", lw=0.5)
    panels[0].set_ylabel("PSNR / dB", fontsize=8)
    figure.suptitle(label, fontsize=10)
    words = f"{label}: PSNR against the size of each mismatch; other methods in grey"
    return Picture(f"robustness-{label}.png", _png(figure), words)


def _draw(panel: "Axes", found: dict[float, list[float]], **style: Any) -> None:  # noqa: ANN401
    panel.plot(list(found), [statistics.fmean(values) for values in found.values()], **style)


def _png(figure: "Figure") -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return data.getvalue()
