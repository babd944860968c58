"""From frames of a point source to the picture of a PSF: averaged, merged, corrected and centred."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mwdn.calibration.dynamic_range import CEILING, merge_exposures
from mwdn.calibration.exposure import measure_exposure
from mwdn.calibration.frame_average import FrameAverage
from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.psf_levels import SATURATED_PART, estimate_background
from mwdn.calibration.sensor_frames import SensorFrames, average_files
from mwdn.errors import PsfError
from mwdn.types import Image

LOW_PEAK = 0.3
"""Peak of the shortest exposure, as a fraction of the full scale, below which a longer one is advised."""


@dataclass(frozen=True, eq=False)
class PointSource:
    """The picture of a point source.

    Args:
        image: (1, C, H, W), in the pixels of the raw frame, linear; 1 is saturation at the shortest exposure, but the
            flat field can amplify more light. Dark frame, flat field and hot pixels are corrected; noise is of either
            sign.
        exposures: relative to the shortest, as measured.
        count: number of frames averaged, of all exposures.
        decades: from the noise of a dark pixel to the brightest one.
        notes: sentences about frames that were left out, and about the exposure.
    """

    image: Image
    exposures: tuple[float, ...]
    count: int
    decades: float
    notes: tuple[str, ...] = ()


def average_point(
    groups: Sequence[Sequence[Path]], exposures: Sequence[float], sensor: SensorFrames, frames: FrameFormat
) -> PointSource:
    """Make the picture of a point source.

    Args:
        groups: files of the frames of each exposure.
        exposures: in milliseconds or any other unit; empty for a single group.
        sensor: dark frames, flat field and hot pixels.
        frames: format of the frames.

    Raises:
        PsfError: the shortest exposure is saturated.
        MwdnError: a file cannot be read, most frames of an exposure are outliers, or exposures do not fit.
    """
    times: list[float | None] = list(exposures) or [None]
    order = sorted(range(len(times)), key=lambda number: times[number] or 0.0)
    averages: list[FrameAverage] = []
    notes: list[str] = []
    for number in order:
        average = average_files(groups[number], frames, dark=sensor.dark(times[number]))
        notes += average.rejected.values()
        if not averages:
            notes += _check_exposure(average, groups[number][0], times[number], sensor, frames)
        averages.append(average)
    merged = merge_exposures(averages, [times[number] or 1.0 for number in order])
    given = [(times[number] or 1.0) / (times[order[0]] or 1.0) for number in order]
    for nominal, measured in zip(given, merged.exposures, strict=True):
        if abs(measured / nominal - 1) > 0.02:
            notes.append(f"The exposure given as {nominal:g} times the shortest has {measured:.3g} times its light.")
    image = sensor.corrections(merged.image, frames.cell)
    dark_noise = float(merged.noise.median())
    peak = max(float(image.amax()), 1e-12)
    decades = float(torch.log10(torch.tensor(peak / max(dark_noise, 1e-12)))) if averages[0].noise else 0.0
    return PointSource(image, merged.exposures, sum(a.count for a in averages), max(decades, 0.0), tuple(notes))


def _check_exposure(
    average: FrameAverage, file: Path, time: float | None, sensor: SensorFrames, frames: FrameFormat
) -> list[str]:
    """Refuse a saturated exposure, the shortest one, and say if it is too short."""
    frame = frames.read_stored(file)[0]
    sensor.check_size(f"Frames of the point source, as `{file.name}`", (frame.shape[0], frame.shape[1]))
    if (defects := sensor.corrections.defects) is not None:
        frame = np.where(defects[0, 0, :, :, None].numpy(), 0, frame).astype(frame.dtype)
    dark = sensor.dark(time)
    format = frames.encoding
    exposure = measure_exposure(frame, format, black=0.0 if dark is None else float(dark.mean()))
    saturated = average.saturated if defects is None else average.saturated & ~defects
    count = int(saturated.sum())
    if count > SATURATED_PART * saturated.numel():
        raise PsfError(
            f"PSF is saturated: {count:,} of {saturated.numel():,} pixels of `{file.name}` are at the sensor's "
            f"maximum, {format.saturated(frame)[1]:,}. Use {exposure.next(time)}, and capture it again."
        )
    notes = []
    if exposure.peak < LOW_PEAK and frame.dtype.kind != "f":
        bits = format.possible_bit_depth(frame)
        unless = f", unless the sensor has {bits} bits: `--bit-depth {bits}`" if bits else ""
        notes.append(f"The peak is at {exposure.peak:.2f} of the full scale: use {exposure.next(time)}{unless}.")
    elif exposure.peak > CEILING:
        notes.append(f"The peak is at {exposure.peak:.2f} of the full scale: use {exposure.next(time)}.")
    return notes


def centring_shift(image: Image, cell: int = 1) -> tuple[int, int]:
    """Whole pixels (down, right) that bring the centroid of a PSF to the centre of its frame.

    A point off the axis displaces the PSF, and with it the field of view of every reconstruction.

    Args:
        image: (1, C, H, W), dark frame subtracted; its 5th percentile counts as darkness if it is above 0.
        cell: 2 for a mosaic, whose colours stay in place.
    """
    plane = (image - estimate_background(image).clamp(min=0)).mean((0, 1)).double()
    total = float(plane.sum())
    if total <= 0:
        return 0, 0
    shift = []
    for axis, length in enumerate(plane.shape):
        centroid = float((plane.sum(1 - axis) * torch.arange(length)).sum()) / total
        shift.append(round((length // 2 - centroid) / cell) * cell)
    return shift[0], shift[1]
