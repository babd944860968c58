"""PSFs of points at other distances and other positions of the field, from the files of a camera."""

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mwdn.calibration.frame_operations import bin_pixels
from mwdn.calibration.psf import Calibration
from mwdn.errors import ParameterError
from mwdn.optics.field import FieldCamera
from mwdn.optics.orientation import turn_displacement
from mwdn.optics.psf import unit_sum
from mwdn.optics.psf_measures import likeness
from mwdn.optics.sensor import Sensor
from mwdn.optics.warp import warp
from mwdn.types import Psf

MAGNIFICATIONS = (0.8, 1.25)
"""Range in which the magnification of one PSF over that of a neighbouring distance is sought."""

_SIDE = 256  # pixels at which it is sought: 1 / 256 of the PSF's size is finer than its effect


def at_distance(calibration: Calibration, distance_mm: float) -> tuple[Calibration, str]:
    """The calibration for points at a distance, and a sentence about where its PSF is from.

    The shadow of a mask at the distance d from the sensor, in the light of a point at z, is magnified by 1 + d / z.
    So between two measured distances, the PSF that is nearer in 1 / z is magnified: by their measured relative
    magnification, interpolated linearly in 1 / z. Diffraction does not scale like a shadow; it stays that of the PSF
    used. Beyond the measured distances the nearest PSF is used as it is.

    Args:
        calibration: with PSFs at other distances.
        distance_mm: of the scene.

    Raises:
        ParameterError: the camera has one distance only, or ``distance_mm`` is not positive.
        MwdnError: a PSF cannot be read.
    """
    if not 0 < distance_mm < float("inf"):
        raise ParameterError(f"`distance` ({distance_mm}) must be positive: millimetres from the scene to the camera.")
    own, places = calibration.distance_mm, calibration.places
    if own is None or not places.distances_mm:
        raise ParameterError(
            f"`distance` ({distance_mm:g}) needs a camera with PSFs at several distances: `mwdn calibrate near/ far/ "
            "--distances 100 300 -o camera.toml`."
        )
    files: dict[float, Path | None] = {own: None, **dict(zip(places.distances_mm, places.distance_psfs, strict=True))}
    ordered = sorted(files, key=lambda z: abs(1 / z - 1 / distance_mm))
    nearest = ordered[0]
    psf = _psf(calibration, files[nearest])
    refined = [name for name in ("psf_gain", "envelope_shift") if getattr(calibration.refinement, name)]
    without = f" Without `{'` and `'.join(refined)}`, found for the PSF of {own:g} mm."
    without = without if refined and files[nearest] else ""
    chosen = replace(calibration, psf=psf, distance_mm=distance_mm, unrefined_hash="")
    other = next((z for z in ordered if (z - distance_mm) * (nearest - distance_mm) < 0), None)
    if abs(nearest / distance_mm - 1) < 1e-3 or other is None:
        beyond = "" if min(files) <= distance_mm * 1.001 and distance_mm <= max(files) * 1.001 else ", the nearest one"
        return chosen, f"PSF of {nearest:g} mm for a scene at {distance_mm:g} mm{beyond}.{without}"
    magnification, alike = relative_magnification(_psf(calibration, files[other]), psf)
    part = (1 / distance_mm - 1 / nearest) / (1 / other - 1 / nearest)
    scale = 1 + part * (magnification - 1)
    moved = warp(psf, scale * torch.eye(2))
    sentence = (
        f"PSF for {distance_mm:g} mm: that of {nearest:g} mm, magnified by {scale:.4f}; that of {other:g} mm has "
        f"{magnification:.4f} times its size (correlation {alike:.2f}).{without}"
    )
    return replace(chosen, psf=unit_sum(moved)), sentence


def relative_magnification(psf: Psf, reference: Psf) -> tuple[float, float]:
    """Magnification of a PSF over another of the same mask, by the best correlation, and that correlation."""
    factor = max(1, max(psf.shape[-2:]) // _SIDE)
    small, other = (bin_pixels(one.mean(1, keepdim=True), factor) for one in (psf, reference))

    def score(scale: float) -> float:
        return likeness(warp(other, scale * torch.eye(2)), small)

    low, high = MAGNIFICATIONS
    best, step = 1.0, (high - low) / 36
    candidates = [low + step * number for number in range(37)]
    while step > 1e-4:
        best = max(candidates, key=score)
        step /= 4
        candidates = [best + step * number for number in range(-4, 5)]
    return best, score(best)


def _psf(calibration: Calibration, file: Path | None) -> Psf:
    return calibration.psf if file is None else _read(calibration, file).psf


def _read(calibration: Calibration, file: Path) -> Calibration:
    """A PSF elsewhere, in the format of the camera's own."""
    done = replace(calibration.corrections, psf_done=True)
    return Calibration.from_file(file, calibration.frames, psf_format=calibration.psf_format, corrections=done)


def psfs_elsewhere(calibration: Calibration) -> tuple[dict[float, Psf], list[tuple[float, Psf]]]:
    """All PSFs of a camera at other distances, and off the axis.

    Returns:
        Those at other distances by the distance in mm, and each PSF off the axis with its displacement in raw pixels.

    Raises:
        MwdnError: a PSF cannot be read.
    """
    places = calibration.places
    far = {z: _psf(calibration, file) for z, file in zip(places.distances_mm, places.distance_psfs, strict=True)}
    moved = [round(math.hypot(*position), 1) for position in places.field_positions]
    return far, [(d, _psf(calibration, file)) for d, file in zip(moved, places.field_psfs, strict=True)]


def field_camera(calibration: Calibration) -> FieldCamera:
    """A camera whose PSF changes over the field as measured; it darkens off the axis as the point source did.

    At each point of the scene the PSF is the mean of the measured ones and of the one on the axis, weighted by the
    inverse square of the distance (Shepard); at a measured point only its own PSF has a weight.

    Args:
        calibration: with PSFs at other positions, which were taken with the exposure of the one on the axis.

    Raises:
        ParameterError: the camera has none.
        MwdnError: a PSF cannot be read.
    """
    places = calibration.places
    if not places.field_psfs:
        raise ParameterError(
            "`field_psfs` of the camera must name PSFs off the axis: `mwdn calibrate psf/ --field ...`."
        )
    points = [(0.0, 0.0), *(_in_measurement(calibration, position) for position in places.field_positions)]
    others = [_read(calibration, file) for file in places.field_psfs]
    light = [sum(one.light) / max(sum(calibration.light), 1e-30) for one in others]
    psfs = torch.cat([calibration.psf, *(level * one.psf for level, one in zip(light, others, strict=True))])
    weights = _shepard(torch.tensor(points), calibration.size)
    return FieldCamera(psfs, weights, sensor=calibration.binned_sensor or Sensor())


def _in_measurement(calibration: Calibration, position: tuple[float, float]) -> tuple[float, float]:
    """Displacement (down, right) in raw pixels of the PSF's frames as one in pixels of a measurement."""
    frames, psf_format = calibration.frames, calibration.psf_format
    raw = frames.cell * (psf_format.psf_bin or frames.bin)
    down, right = position[0] / raw, position[1] / raw
    down = -down if frames.upside_down else down
    orientation = psf_format.psf_orientation
    return (down, right) if orientation is None else turn_displacement(down, right, orientation)


def _shepard(points: Tensor, size: tuple[int, int]) -> Tensor:
    """Weights (points, 1, height, width) at each pixel of the scene of points (N, 2), in pixels from the centre."""
    rows, columns = (torch.arange(n, dtype=torch.float32) - n // 2 for n in size)
    grid = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1)
    square = (grid - points[:, None, None]).square().sum(-1).clamp(min=1e-6)
    return (1 / square / (1 / square).sum(0))[:, None]
