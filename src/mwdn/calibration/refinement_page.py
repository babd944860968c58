"""The terms of a refinement as one page of maps, drawn by matplotlib."""

from pathlib import Path

from torch import Tensor

from mwdn.calibration.refinement import Refinement
from mwdn.io.files import atomic_write
from mwdn.io.images import srgb_encode
from mwdn.types import Psf, size_of


def write_refinement_page(path: Path, psf: Psf, refinement: Refinement, lines: list[str]) -> None:
    """Draw the PSF before and after, the gain of each colour, the sensor's field and the stray light; write a PNG.

    Args:
        path: of the picture.
        psf: as calibrated.
        refinement: its terms.
        lines: text under the maps.

    Raises:
        ImageError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    size = size_of(psf)
    refined = refinement.psf(psf)
    maps: list[tuple[str, Tensor]] = []
    ratio = (refined / psf.clamp(min=1e-3 * float(psf.amax())))[0]
    for name, plane in zip(("red", "green", "blue") if psf.shape[1] == 3 else ("grey",), ratio, strict=True):
        maps.append((f"gain over the PSF, {name}", plane))
    for name, field in (("sensor field", refinement.field_map(size)), ("stray light", refinement.stray_map(size))):
        if field is not None:
            maps.append((name, field.mean(1)[0]))
    columns = max(3, len(maps))
    figure = Figure(figsize=(3.6 * columns, 4.8), dpi=100, layout="constrained")
    axes = figure.subplots(2, columns)
    bright = psf.flatten().sort().values[int(0.998 * (psf.numel() - 1))].clamp(min=1e-30)
    for axis, (name, image) in zip(axes[0], (("PSF as calibrated", psf), ("PSF refined", refined)), strict=False):
        shown = srgb_encode((image[0] / bright).clamp(0, 1)).movedim(0, -1).numpy()
        axis.imshow(shown if shown.shape[-1] == 3 else shown[..., 0], cmap="gray")
        axis.set_title(name, fontsize=10)
    axes[0, 2].text(0, 1, "\n".join(lines), va="top", fontsize=8, wrap=True)
    for axis in (*axes[0, 2:], *axes[1, len(maps) :]):
        axis.set_axis_off()
    for axis, (name, plane) in zip(axes[1], maps, strict=False):
        shown = axis.imshow(plane.numpy(), cmap="viridis")
        figure.colorbar(shown, ax=axis, shrink=0.7)
        axis.set_title(name, fontsize=10)
    with atomic_write(path) as temporary:
        figure.savefig(temporary)
