"""Mask files: a 16-bit height map that can be read back; GDSII and STL for fabrication."""

import errno
import json
import math
import os
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import torch

from mwdn.arguments import check_at_least
from mwdn.errors import ImageError, ParameterError, reason
from mwdn.io.files import atomic_write
from mwdn.io.reading import open_regular
from mwdn.io.tiff import read_tiff
from mwdn.optics.masks import Mask
from mwdn.runtime.requirement import require

_FORMAT = "mwdn mask 1"
_DEEPEST = 256
"""Levels of a continuous surface in GDSII: 8 layers."""

_GDS_END = b"\0\4\4\0"  # the record ENDLIB

MAX_STL_SAMPLES = 4_000_000
"""Two triangles of 50 bytes a sample: 400 MB, about the largest file that slicers open."""

BASE_UM = 100.0
"""Thickness of an STL's body below height 0."""


def write_mask(path: str | Path, mask: Mask) -> None:
    """Write a mask as 16-bit grey TIFF, atomically: ``value = number * scale``.

    The tag ImageDescription holds scale, pitch and index as JSON; the resolution tags hold the pitch, too.

    Args:
        path: the TIFF.
        mask: heights in levels are stored exactly, others rounded to 1/65,535 of the highest.

    Raises:
        ImageError: the file cannot be written.
        ParameterError: a height or amplitude is negative.
    """
    import tifffile

    values = mask.values.numpy().astype(np.float64)
    highest = float(values.max())
    if values.min() < 0 or (mask.kind == "amplitude" and highest > 1):
        raise ParameterError(
            f"`values` of a mask ({values.min():g} to {highest:g}) must be 0 or more, amplitudes at most 1."
        )
    scale = highest / 65535 if highest > 0 else 1.0
    if mask.step_um > 0:
        levels = max(1, round(highest / mask.step_um))
        scale = mask.step_um / (65535 // levels)
    about = {
        "format": _FORMAT,
        "kind": mask.kind,
        "scale": scale,
        "unit": "um" if mask.kind == "phase" else "amplitude",
        "pitch_um": mask.pitch_um,
        "index": mask.index,
        "step_um": mask.step_um,
    }
    per_cm = 1e4 / mask.pitch_um
    with atomic_write(path) as temporary:
        tifffile.imwrite(
            temporary,
            np.rint(values / scale).astype(np.uint16),
            photometric="minisblack",
            compression="zlib",
            description=json.dumps(about),
            metadata=None,
            resolution=(per_cm, per_cm),
            resolutionunit="CENTIMETER",
        )


def read_mask(path: str | Path) -> Mask:
    """Read a mask written by `write_mask`.

    Raises:
        ImageError: the file cannot be read, or `write_mask` did not write it.
    """
    with open_regular(path) as file:
        try:
            return _read_mask(file)
        except ImageError as error:
            raise type(error)(f"`{path}` {error}") from error
        except OSError as error:
            raise ImageError(f"`{path}` cannot be read: {error.strerror or error}. Copy it again.") from error
        except Exception as error:  # a foreign file can raise anything in tifffile and json
            what = f"{type(error).__name__}: {reason(error)}"
            raise ImageError(f"`{path}` is not a mask written by `mwdn design` ({what}). Give its mask.tif.") from error


def _read_mask(file: BinaryIO) -> Mask:
    import tifffile

    with tifffile.TiffFile(file, is_ome=False) as tiff:
        about = json.loads(str(tiff.pages[0].tags["ImageDescription"].value))  # type: ignore[union-attr]
    if about["format"] != _FORMAT:
        raise KeyError("format")
    numbers, _ = read_tiff(file, lambda shape, dtype: None)
    if numbers.ndim != 2:
        raise KeyError("format")
    values = torch.from_numpy((numbers * about["scale"]).astype(np.float32))
    if step_um := about["step_um"]:
        values = (values / step_um).round() * step_um  # exactly as a design computes them
    return Mask(about["kind"], values, about["pitch_um"], about["index"], step_um)


def write_gds(path: str | Path, mask: Mask) -> None:
    """Write GDSII for lithography, one layer an exposure: unit 1 um, y upwards, origin in the middle of the mask.

    Levels are binary numbers: layer k (from 0) holds the squares whose level has bit k set, to be raised (or their
    complement etched) by ``2^k`` steps; 8 levels need 3 layers. A continuous surface is rounded to 256 levels. Of an
    amplitude mask, layer 0 holds the open squares.

    Args:
        path: the file.
        mask: of either kind.

    Raises:
        MissingPackageError: gdstk is not installed.
        ImageError: the file cannot be written.
    """
    gdstk = require("gdstk", "fabrication", purpose="GDSII")
    level = _levels(mask)
    rows, columns = level.shape
    library = gdstk.Library("mwdn", unit=1e-6, precision=1e-9)
    cell = library.new_cell("MASK")
    for layer in range(max(1, int(level.max()).bit_length())):
        for top, bottom, left, right in _rectangles((level >> layer) & 1).tolist():
            # Sample i covers i - 1/2 to i + 1/2; sample n // 2 is the origin; rows count downwards, y upwards.
            corner = ((left - columns // 2 - 0.5) * mask.pitch_um, -(top - rows // 2 - 0.5) * mask.pitch_um)
            other = ((right - columns // 2 - 0.5) * mask.pitch_um, -(bottom - rows // 2 - 0.5) * mask.pitch_um)
            cell.add(gdstk.rectangle(corner, other, layer=layer))
    with atomic_write(path) as temporary:
        library.write_gds(temporary)
        # gdstk does not report a full disk: the file then lacks its end record or some of the rectangles.
        if temporary.read_bytes()[-4:] != _GDS_END or gdstk.gds_info(temporary)["num_polygons"] != len(cell.polygons):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def check_stl(mask: Mask, *, every: int = 1) -> None:
    """Raise the `ParameterError` of `write_stl` for the same arguments, before anything is written."""
    if mask.kind != "phase":
        raise ParameterError("An amplitude mask has no heights for an STL. Use GDSII: `gds`.")
    check_at_least(1, every=every)
    rows, columns = (len(_chosen(length, every)) for length in mask.values.shape)
    if rows * columns > MAX_STL_SAMPLES or min(rows, columns) < 2:
        needed = every
        while math.prod(len(_chosen(length, needed)) for length in mask.values.shape) > MAX_STL_SAMPLES:
            needed += 1
        raise ParameterError(
            f"An STL ({rows:,} x {columns:,} samples) must have at least 2 samples a side and at "
            f"most {MAX_STL_SAMPLES:,} in all: `--stl-every {needed}`, in Python `every={needed}`; or use GDSII."
        )


def write_stl(path: str | Path, mask: Mask, *, every: int = 1) -> None:
    """Write a phase mask as a closed body in binary STL, in um: the surface, four walls and a flat bottom.

    It has the mask's size, and the origin of `write_gds`: the outermost samples lie at the mask's edges.

    Args:
        path: the file.
        mask: a phase mask. A step from one level to the next becomes a slope as wide as the pitch; at the edges
            the slope is half a sample wider.
        every: use every n-th sample along each axis, and the last one.

    Raises:
        ParameterError: an amplitude mask, `every` below 1, or more than `MAX_STL_SAMPLES`.
        ImageError: the file cannot be written.
    """
    check_stl(mask, every=every)
    rows, columns = (_chosen(length, every) for length in mask.values.shape)
    heights = mask.values.numpy()[np.ix_(rows, columns)].astype(np.float64)
    height, width = mask.values.shape
    y, x = -_places(rows, height) * mask.pitch_um, _places(columns, width) * mask.pitch_um
    triangles = np.concatenate(list(_body(heights + BASE_UM, y, x)))
    sides = triangles[:, 1:] - triangles[:, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    facets = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("_", "<u2")])
    facets["normal"], facets["corners"] = normals, triangles
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(b"mwdn mask, unit um".ljust(80))
        file.write(np.uint32(len(facets)).tobytes())
        facets.tofile(file)


def _levels(mask: Mask) -> npt.NDArray[np.int64]:
    values = mask.values.numpy().astype(np.float64)
    if mask.kind == "amplitude":
        return (values > 0.5).astype(np.int64)
    step = mask.step_um or max(float(values.max()), 1e-12) / (_DEEPEST - 1)
    return np.rint(values / step).astype(np.int64)


def _rectangles(filled: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Cover filled squares with rectangles (top, bottom, left, right): runs in a row, joined with equal runs below."""
    change = np.diff(np.pad(filled, ((0, 0), (1, 1))), axis=1)
    (row, left), (_, right) = np.nonzero(change == 1), np.nonzero(change == -1)
    order = np.lexsort((row, right, left))
    row, left, right = row[order], left[order], right[order]
    if not len(row):
        return np.empty((0, 4), np.int64)
    joined = (np.diff(row) == 1) & (np.diff(left) == 0) & (np.diff(right) == 0)
    first = np.flatnonzero(np.r_[True, ~joined])
    last = np.r_[first[1:] - 1, len(row) - 1]
    return np.stack([row[first], row[last] + 1, left[first], right[first]], axis=1)


def _chosen(length: int, every: int) -> npt.NDArray[np.int64]:
    """Every ``every``-th of ``length`` samples, and the last one."""
    return np.unique(np.append(np.arange(0, length, every), length - 1))


def _places(chosen: npt.NDArray[np.int64], length: int) -> npt.NDArray[np.float64]:
    """Places of the chosen samples, in samples from the middle of ``length``; the outermost are at the edges."""
    places = chosen - length // 2.0
    return np.concatenate([[places[0] - 0.5], places[1:-1], [places[-1] + 0.5]])


def _body(heights: npt.NDArray[Any], rows: npt.NDArray[Any], columns: npt.NDArray[Any]) -> Any:  # noqa: ANN401
    """Triangles (n, 3 corners, xyz) of top, walls and bottom, counter-clockwise seen from outside.

    The bottom is a fan from its middle to every point of the border, so that each edge belongs to two triangles.

    Args:
        heights: of the surface above the bottom.
        rows: their y, descending.
        columns: their x.
    """
    y, x = np.meshgrid(rows, columns, indexing="ij")
    top = np.stack([x, y, heights], axis=-1)
    a, b, c, d = top[:-1, :-1], top[:-1, 1:], top[1:, :-1], top[1:, 1:]
    yield np.stack([a, c, d], axis=-2).reshape(-1, 3, 3)
    yield np.stack([a, d, b], axis=-2).reshape(-1, 3, 3)
    # The border, counter-clockwise seen from above: down the left side, along the bottom row, up, back.
    border = np.concatenate([top[:-1, 0], top[-1, :-1], top[:0:-1, -1], top[0, :0:-1]])
    following = np.roll(border, -1, axis=0)
    low, low_following = (
        np.concatenate([points[:, :2], np.zeros((len(points), 1))], 1) for points in (border, following)
    )
    yield np.stack([border, low, low_following], axis=1)
    yield np.stack([border, low_following, following], axis=1)
    middle = np.broadcast_to(np.array([x.mean(), y.mean(), 0.0]), low.shape)
    yield np.stack([low_following, low, middle], axis=1)
