"""Write an `Interpretation`: one sheet, each picture in a file, and the numbers as JSON."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mwdn.inference.interpretation import Interpretation, Panel, Row
from mwdn.io.contact_sheets import to_display
from mwdn.io.files import atomic_write, write_json
from mwdn.io.images import srgb_decode, srgb_encode, write_picture

SHEET, JSON = "interpretation.png", "interpretation.json"

SIGNS = {"inverted": "inverted", "largest_gain": "gain", "share_of_picture": "share", "residual": "unexplained"}
"""Numbers under their short names on the sheet; the others are written as they are."""


def write_interpretation(folder: Path, interpretation: Interpretation, **about: object) -> list[Path]:
    """Write the sheet, the JSON and the pictures; returns their paths.

    Args:
        folder: for `SHEET`, `JSON`, and the pictures in ``pictures``.
        interpretation: to write.
        **about: further entries of the JSON: capture, method, PSF.

    Raises:
        ImageError: a file cannot be written.
    """
    paths = [folder / SHEET, folder / JSON]
    pictures = folder / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    write_json(paths[1], {**about, **interpretation.content()})  # first: it marks the folder as one of this command
    for number, row in enumerate(interpretation.rows):
        for panel in row.panels:
            name = re.sub(r"[^a-z0-9.]+", "-", f"{row.name} {panel.name}".lower().replace("1/", ""))
            paths.append(pictures / f"{number}-{name.strip('-')}.png")
            write_picture(paths[-1], srgb_decode(display(panel)))
    draw_sheet(paths[0], interpretation)
    return paths


def display(panel: Panel) -> Tensor:
    """A panel as sRGB values in [0, 1], (1, 3, H, W).

    Light and PSFs are scaled to their brightest pixels; PSFs are also raised to the power 0.5, so that faint parts are
    visible. Features are scaled to their 0.3 to 99.7 % values. A change is grey where it is 0, brighter where it adds.
    """
    picture = panel.picture.float().cpu()
    if panel.kind in ("light", "psf"):
        light = to_display(picture.clamp(min=0))
        shown = light.sqrt() if panel.kind == "psf" else srgb_encode(light)
    elif panel.kind == "change":
        shown = 0.5 + 0.5 * picture / max(_quantiles(picture.abs(), 0.997)[0], 1e-12)
    else:
        low, high = _quantiles(picture, 0.003, 0.997)
        shown = (picture - low) / max(high - low, 1e-12)
    return shown.clamp(0, 1).expand(-1, 3, -1, -1)


def _quantiles(picture: Tensor, *parts: float) -> list[float]:
    """As `torch.quantile`, which takes at most 2^24 numbers."""
    values: list[float] = np.quantile(picture.numpy(), parts).tolist()
    return values


def draw_sheet(path: Path, interpretation: Interpretation) -> None:
    """Draw all rows on one page.

    Raises:
        ImageError: it cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = interpretation.rows
    columns = max(len(row.panels) for row in rows)
    height, width = rows[0].panels[0].picture.shape[-2:]
    side = 2.3
    figure = Figure(figsize=(side * columns + 1.6, (side * height / width + 0.32) * len(rows) + 0.2), dpi=110)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for axes, row in zip(grid, rows, strict=True):
        for axis in axes:
            axis.set_axis_off()
        for axis, panel in zip(axes, row.panels, strict=False):
            axis.imshow(display(panel)[0].movedim(0, -1).numpy(), interpolation="nearest")
            axis.set_title(panel.name, fontsize=8, pad=3)
        axes[0].text(-0.06, 0.5, _caption(row), transform=axes[0].transAxes, ha="right", va="center", fontsize=8)
    left = 1.5 / (side * columns + 1.6)
    figure.subplots_adjust(left=left, right=0.995, top=0.97, bottom=0.01, wspace=0.04, hspace=0.12)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png")


def _caption(row: Row) -> str:
    lines = [row.name]
    for name, value in row.numbers.items():
        if value is not None:
            lines.append(f"{SIGNS.get(name, name)} {_short(name, value)}")
    return "\n".join(lines)


def _short(name: str, value: Any) -> str:  # noqa: ANN401
    return f"{value:.0%}" if name in ("inverted", "share_of_picture", "residual") else f"{value:.3g}"
