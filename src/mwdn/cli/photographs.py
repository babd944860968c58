"""Options of `mwdn calibrate` for its photographs."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mwdn.calibration.photographs import CalibrationFrames, expanded, grouped
from mwdn.calibration.sensor_frames import SensorFiles
from mwdn.errors import ParameterError

Files = Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative=())]
WITHOUT = (Path("none"),)
"""Files that stand for doing without what the camera file says."""

Numbers = Annotated[tuple[float, ...], Parameter(consume_multiple=True, negative=())]


@Parameter(name="*")
@dataclass(frozen=True)
class PhotographOptions:
    """Photographs that describe the camera, and how they were taken. A folder stands for the frames in it.

    Args:
        exposures: exposure in milliseconds of each equal part of the frames, in order: --exposures 1 8 64. Several, up
            to eight, are merged to high dynamic range.
        dark: frames taken without light, or with the source switched off, several; subtracted from the PSF and the
            captures.
        dark_exposures: exposure in milliseconds of each folder of dark frames, or of each equal part of the files, if
            they differ.
        flat: frames of even light, in pairs of the same exposure: flat field, gain and read noise; none to do without
            the camera file's flat field.
        flat_dark: dark frames with the exposure of the flat frames; --dark unless given, if it has one exposure.
        flat_through_mask: the flat frames were taken through the mask: no flat field, gain and read noise alone.
        capture_exposure: exposure of the captures in milliseconds, one of --dark-exposures, whose dark frame they have;
            the longest unless given.
        distances: distance of the point source in each equal part of the frames, in millimetres; the first is the
            camera's own.
        field: frames of points off the axis, each a file or a folder, with the exposure of the shortest frames.
        centre: move the PSF's centroid to the centre of the frame; the default for several frames.
    """

    _: KW_ONLY
    exposures: Numbers = ()
    dark: Files = ()
    dark_exposures: Numbers = ()
    flat: Files = ()
    flat_dark: Files = ()
    flat_through_mask: Annotated[bool, Parameter(negative=())] = False
    capture_exposure: float | None = None
    distances: Numbers = ()
    field: Files = ()
    centre: bool | None = None

    @property
    def dark_files(self) -> tuple[Path, ...]:
        """Files of --dark; --dark none does without."""
        return () if self.dark == WITHOUT else self.dark

    def are_one_picture(self, files: Sequence[Path]) -> bool:
        """Whether a camera file can name these pictures as they are."""
        others = (self.exposures, self.dark_exposures, self.distances, self.field, self.centre)
        flats = (self.flat, self.flat_dark, self.flat_through_mask)
        is_plain = not any((*others, *flats)) and self.capture_exposure is None
        return is_plain and len(expanded(files)) <= 1 and len(expanded(self.dark_files)) <= 1

    def of(self, pictures: Sequence[Path]) -> CalibrationFrames:
        """The photographs, with these pictures of the point source.

        Raises:
            ParameterError: a folder is empty, the pictures cannot be divided into exposures and distances, or options
                for flat frames are given without those.
        """
        if not self.flat and (self.flat_dark or self.flat_through_mask):
            given = "flat_dark" if self.flat_dark else "flat_through_mask"
            raise ParameterError(f"`{given}` needs flat frames: `flat`. Give them, or leave it out.")
        dark = grouped(self.dark_files, max(1, len(self.dark_exposures)), "dark") if self.dark_files else ()
        flat, flat_dark = (tuple(expanded(each)) for each in (self.flat, self.flat_dark))
        groups = max(1, len(self.exposures)) * max(1, len(self.distances))
        return CalibrationFrames(
            grouped(pictures, groups, "PSF"),
            exposures=self.exposures,
            sensor=SensorFiles(
                dark, self.dark_exposures, flat, flat_dark, not self.flat_through_mask, self.capture_exposure
            ),
            distances_mm=self.distances,
            field=tuple(tuple(expanded([path])) for path in self.field),
            centre=self.centre is not False,
        )
