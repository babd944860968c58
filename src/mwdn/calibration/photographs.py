"""From all photographs of a camera to the content of its camera file."""

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.calibration.camera_parts import picture_of
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.frame_average import Kind
from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.places import relative_magnification
from mwdn.calibration.point_source import PointSource, average_point, centring_shift
from mwdn.calibration.sensor_frames import SensorFiles, SensorFrames, equal_parts, measure_sensor
from mwdn.errors import ParameterError
from mwdn.io.listing import list_folder
from mwdn.optics.displacement import displacement, shifted
from mwdn.types import Frame, Image

MAGNIFICATION_ERROR = 0.003
"""Of `relative_magnification`: a PSF that is larger by less may be smaller."""

MIN_CORRELATION = 0.7
"""Correlation of PSFs at two distances below which their magnification says nothing."""


@dataclass(frozen=True)
class CalibrationFrames:
    """Frames of a point source, and of the sensor.

    Args:
        groups: files of the point source's frames: for each distance, those of each exposure.
        exposures: in milliseconds or any other unit; empty for one exposure.
        sensor: dark and flat frames.
        distances_mm: of the point source; the first is the camera's own. Empty for one distance.
        field: files of points off the axis, taken with the shortest exposure.
        centre: move each PSF's centroid to the centre of the frame.

    Raises:
        ParameterError: exposures or distances do not divide the groups, or are not positive and different; or a file is
            named twice.
    """

    groups: tuple[tuple[Path, ...], ...]
    _: KW_ONLY
    exposures: tuple[float, ...] = ()
    sensor: SensorFiles = SensorFiles()
    distances_mm: tuple[float, ...] = ()
    field: tuple[tuple[Path, ...], ...] = ()
    centre: bool = True

    def __post_init__(self) -> None:
        for name in ("exposures", "distances_mm"):
            numbers = getattr(self, name)
            if len(set(numbers)) < len(numbers) or not all(0 < number < float("inf") for number in numbers):
                option = name.removesuffix("_mm")
                raise ParameterError(
                    f"`{option}` ({', '.join(f'{n:g}' for n in numbers)}) must be positive and differ."
                )
        needed = max(1, len(self.exposures)) * max(1, len(self.distances_mm))
        if len(self.groups) != needed:
            raise ParameterError(f"`groups` ({len(self.groups)}) must be {needed}, one for each exposure and distance.")
        files = [*chain(*self.groups, *self.field, *self.sensor.dark), *self.sensor.flat]
        for named in (files, self.sensor.flat_dark):  # those of the flat frames may be dark frames of the captures
            counts = Counter(map(os.path.realpath, named))
            if twice := [file for file in named if counts[os.path.realpath(file)] > 1]:
                raise ParameterError(f"`{twice[-1]}` is named twice. Name each frame once, as one kind.")


def expanded(paths: Sequence[Path]) -> list[Path]:
    """Files, and the frames in folders in alphabetical order."""
    files: list[Path] = []
    for path in paths:
        listed = [Path(name) for name in list_folder(path)[0]] if path.is_dir() else [path]
        if not listed:
            raise ParameterError(f"The folder `{path}` holds no frame. Save the camera's frames in it.")
        files += listed
    return files


def grouped(paths: Sequence[Path], count: int, kind: Kind) -> tuple[tuple[Path, ...], ...]:
    """Files in groups: one for each path if there are as many, otherwise equal parts in order."""
    parts = [expanded([path]) for path in paths] if len(paths) == count else equal_parts(expanded(paths), count, kind)
    return tuple(map(tuple, parts))


@dataclass(frozen=True, eq=False)
class CameraContent:
    """Result of `calibrate_frames`: the content of a camera file, its pictures, and sentences for the user."""

    content: dict[str, Any]
    parts: dict[str, Frame | list[Frame]]
    notes: list[str]
    results: list[str]
    flat_colour: tuple[float, ...] = ()


def calibrate_frames(
    photographs: CalibrationFrames, frames: FrameFormat, known: Corrections = Corrections()
) -> CameraContent:
    """Average, merge, correct and centre the frames of a point source; measure the sensor.

    Args:
        photographs: the files, and how they were taken.
        frames: format of the frames.
        known: flat field and hot pixels of an earlier calibration.

    Raises:
        MwdnError: a file cannot be read, frames disagree, or are saturated.
    """
    _, frames = frames.read_stored(photographs.groups[0][0])  # a raw file states its own mosaic
    sensor = measure_sensor(photographs.sensor, frames, known)
    exposures, distances = photographs.exposures, photographs.distances_mm
    groups, count = photographs.groups, max(1, len(exposures))
    points = [
        average_point(groups[start : start + count], exposures, sensor, frames)
        for start in range(0, len(groups), count)
    ]
    own = points[0]
    places = [
        average_point([group], [min(exposures)] if exposures else [], sensor, frames) for group in photographs.field
    ]
    shift = centring_shift(own.image, frames.cell) if photographs.centre else (0, 0)
    reference, *elsewhere = _within_full_scale(own.image, *(place.image for place in places))
    parts: dict[str, Frame | list[Frame]] = {"psf": psf_frame(shifted(reference, *shift), frames)}
    content: dict[str, Any] = {"mosaic": frames.mosaic, "psf_corrected": True}
    notes = [*sensor.notes, *(note for point in points for note in point.notes)]
    if len(distances) > 1:
        content |= {"distance_mm": distances[0], "distances_mm": tuple(distances[1:])}
        images = [_centred(point, photographs, frames) for point in points]
        notes += _wrong_order(dict(zip(distances, images, strict=True)))
        parts["distance_psfs"] = [psf_frame(image, frames) for image in images[1:]]
    elif distances:
        content["distance_mm"] = distances[0]
    if photographs.field:
        content["field_positions"], parts["field_psfs"] = _field(elsewhere, reference, shift, frames)
        notes += [note for place in places for note in place.notes]
    sensor_content, sensor_parts = of_sensor(sensor, frames)
    results = [_summary(own, shift, "px" if frames.cell == 1 else "raw px"), *describe_sensor(sensor)]
    return CameraContent(content | sensor_content, parts | sensor_parts, notes, results, sensor.flat_colour)


def psf_frame(image: Image, frames: FrameFormat) -> Frame:
    """The file's numbers of a linear image; the PSF's file has no gamma of its own."""
    return FrameFormat(bit_depth=frames.bit_depth, bgr=frames.bgr).denormalise(image)


def _within_full_scale(*images: Image) -> list[Image]:
    """The images over their brightest pixel if that is above 1, which no file can hold; their ratios stay."""
    brightest = max(1.0, *(float(image.amax()) for image in images))
    return [image / brightest for image in images]


def _centred(point: PointSource, photographs: CalibrationFrames, frames: FrameFormat) -> Image:
    (image,) = _within_full_scale(point.image)
    return shifted(image, *centring_shift(image, frames.cell)) if photographs.centre else image


def _wrong_order(images: dict[float, Image]) -> Iterator[str]:
    """A sentence for each distance whose PSF is larger than that of the next nearer one: it must be smaller."""
    for near, far in pairwise(sorted(images)):
        magnification, alike = relative_magnification(images[far], images[near])
        if magnification > 1 + MAGNIFICATION_ERROR and alike > MIN_CORRELATION:
            yield (
                f"The PSF at {far:g} mm is {magnification:.3f} times as large as at {near:g} mm, but a nearer point "
                "casts a larger shadow. Give `--distances` in the order of the frames."
            )


def _field(
    places: Sequence[Image], reference: Image, shift: tuple[int, int], frames: FrameFormat
) -> tuple[tuple[tuple[float, float], ...], list[Frame]]:
    """Displacements of the points off the axis, and their PSFs moved back onto the one on the axis."""
    positions, pictures = [], []
    for place in places:
        down, right, _ = displacement(place, reference)
        positions.append((round(down, 2), round(right, 2)))
        back = (round(-moved / frames.cell) * frames.cell for moved in (down, right))
        total = [step + own for step, own in zip(back, shift, strict=True)]
        pictures.append(psf_frame(shifted(place, total[0], total[1]), frames))
    return tuple(positions), pictures


def of_sensor(sensor: SensorFrames, frames: FrameFormat) -> tuple[dict[str, Any], dict[str, Frame | list[Frame]]]:
    """Keys and pictures of a camera file that describe its sensor."""
    content: dict[str, Any] = {}
    parts: dict[str, Frame | list[Frame]] = {}
    if (dark := sensor.capture_dark) is not None:
        parts["dark"], content["dark_exposure"] = frames.denormalise(dark), sensor.dark_exposure
        content["black_level"] = round(float(dark.mean()), 6)
    if sensor.corrections.flat is not None:
        parts["flat_field"] = np.ascontiguousarray(sensor.corrections.flat[0].movedim(0, -1).numpy(), np.float32)
    if sensor.corrections.count:
        assert sensor.corrections.defects is not None
        parts["hot_pixels"] = picture_of(sensor.corrections.defects)
    if (transfer := sensor.transfer) is not None:
        content |= {
            "electrons_per_count": round(transfer.electrons_per_count, 5),
            "read_noise_electrons": round(transfer.read_noise, 4),
            "full_well_electrons": round(transfer.full_well, 1),
            "black_level": round(transfer.black_level, 6),
        }
    return content, parts


def _summary(point: PointSource, shift: tuple[int, int], unit: str) -> str:
    merged = "" if len(point.exposures) == 1 else f" at {len(point.exposures)} exposures, merged"
    range_ = f"; {point.decades:.1f} decades from the noise to the peak" if point.decades else ""
    frames = "1 frame" if point.count == 1 else f"{point.count} frames"
    return f"{frames} averaged{merged}{range_}. Moved by ({shift[0]}, {shift[1]}) {unit} to the centre."


def describe_sensor(sensor: SensorFrames) -> list[str]:
    """Sentences about hot pixels and noise."""
    sentences = []
    if (defects := sensor.corrections.defects) is not None:
        part = sensor.corrections.count / defects.numel()
        sentences.append(f"{sensor.corrections.count:,} hot or dead pixels ({part:.3%}) are replaced.")
    if (transfer := sensor.transfer) is not None:
        sentences.append(
            f"Sensor: {transfer.electrons_per_count:.3g} electrons per count (standard error {transfer.error:.1%}), "
            f"read noise {transfer.read_noise:.2g} electrons, full well {transfer.full_well:,.0f} electrons."
        )
        if transfer.clipped:
            sentences.append(
                "The black level cuts off the noise of darkness, so the read noise is too small: raise the camera's "
                "offset. Reading a raw file cuts it off, too: export frames with their black level as 16-bit TIFF."
            )
    return sentences
