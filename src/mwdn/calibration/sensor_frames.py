"""Measure a sensor with dark and flat frames: dark level, hot pixels, flat field, noise, colour of the light."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import torch
from torch import Tensor

from mwdn.calibration.corrections import Corrections
from mwdn.calibration.frame_average import FrameAverage, Kind, average_frames
from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.frame_operations import demosaic
from mwdn.calibration.hot_pixels import find_dead_pixels, find_hot_pixels
from mwdn.calibration.noise_model import TYPICAL, fit_line
from mwdn.calibration.photon_transfer import SAME_LIGHT, PhotonTransfer, photon_transfer
from mwdn.errors import ParameterError, ShapeError
from mwdn.types import Frame, Image, Plane, Size, size_of

MIN_RESPONSE = 0.1
"""Smallest value of a flat field: a pixel with less light is replaced, not amplified."""

MAX_DEAD = 0.2
"""Largest part of the pixels of flat frames that may be unlike their neighbours. More are a pattern, or noise."""


@dataclass(frozen=True)
class SensorFiles:
    """Frames that describe the sensor.

    Args:
        dark: without light, several for each of ``dark_exposures``.
        dark_exposures: empty if all have the same.
        flat: of even light at about half of the full scale, in pairs of the same exposure.
        flat_dark: without light and with the exposure of the flat frames; ``dark`` of a single exposure unless given.
        flat_field: whether the flat frames' light is even; otherwise only the noise is measured from them.
        capture_exposure: that of the captures, one of ``dark_exposures``; the longest unless given.

    Raises:
        ParameterError: the dark frames and ``dark_exposures`` are not as many, ``capture_exposure`` is none of them, or
            it is not known which dark frames belong to the flat frames.
    """

    dark: tuple[tuple[Path, ...], ...] = ()
    dark_exposures: tuple[float, ...] = ()
    flat: tuple[Path, ...] = ()
    flat_dark: tuple[Path, ...] = ()
    flat_field: bool = True
    capture_exposure: float | None = None

    def __post_init__(self) -> None:
        known = ", ".join(f"{time:g}" for time in self.dark_exposures) or "none"
        if (self.dark or self.dark_exposures) and len(self.dark) != max(1, len(self.dark_exposures)):
            raise ParameterError(
                f"`dark_exposures` ({known}) needs dark frames for each. Give those, a folder for each: `dark`."
            )
        if self.capture_exposure is not None and self.capture_exposure not in self.dark_exposures:
            raise ParameterError(
                f"`capture_exposure` ({self.capture_exposure:g}) must be one of `dark_exposures` ({known}): it chooses "
                "the dark frame of the captures. Give the exposures of the dark frames, or leave it out."
            )
        if self.flat and len(self.dark) > 1 and not self.flat_dark:
            raise ParameterError(
                f"`flat_dark` must name dark frames with the exposure of the flat frames, because the other dark "
                f"frames have several ({known})."
            )


@dataclass(frozen=True, eq=False)
class SensorFrames:
    """The sensor, as measured.

    Args:
        darks: average of the dark frames, by exposure; ``None`` for any exposure.
        corrections: flat field and hot pixels.
        transfer: gain and noise; ``None`` without pairs of flat and dark frames.
        flat_colour: mean of red, green and blue of the flat frames; empty without colours.
        notes: sentences about what was found.
        capture_exposure: of the captures; that of the longest dark frames if it is ``None``.
    """

    darks: dict[float | None, FrameAverage]
    corrections: Corrections
    transfer: PhotonTransfer | None = None
    flat_colour: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    capture_exposure: float | None = None

    def dark(self, exposure: float | None) -> Image | None:
        """The dark frame for an exposure.

        Raises:
            ParameterError: there are dark frames of other exposures only.
        """
        if not self.darks:
            return None
        if None in self.darks:
            return self.darks[None].image
        if exposure is None or exposure not in self.darks:
            known = ", ".join(f"{time:g}" for time in self.darks if time is not None)
            missing = "Give `exposures`" if exposure is None else f"There is none for {exposure:g}"
            raise ParameterError(f"`dark_exposures` ({known}) must have one for each of `exposures`. {missing}.")
        return self.darks[exposure].image

    def check_size(self, what: str, size: Size) -> None:
        """Raise a `ShapeError` if frames, ``what`` in the plural, have another size than the map of hot pixels."""
        defects = self.corrections.defects
        if defects is not None and tuple(defects.shape[-2:]) != tuple(size):
            got, wanted = (" x ".join(map(str, each)) for each in (size, defects.shape[-2:]))
            raise ShapeError(
                f"{what} ({got}) must have the size of the camera's dark and flat frames ({wanted}). Take them with "
                "the same settings of the sensor."
            )

    @property
    def capture_dark(self) -> Image | None:
        """The dark frame of the captures.

        Raises:
            ParameterError: there is none of their exposure.
        """
        return self.dark(self.dark_exposure)

    @property
    def dark_exposure(self) -> float | None:
        """Exposure of the captures' dark frame; ``None`` if there is none, or if it is for any exposure."""
        return self._longest if self.capture_exposure is None else self.capture_exposure

    @property
    def longest_dark(self) -> FrameAverage | None:
        """The dark frame of the longest exposure, which shows hot pixels best."""
        return self.darks.get(self._longest)

    @property
    def _longest(self) -> float | None:
        return max(self.darks, key=lambda time: time or 0.0, default=None)


def average_files(
    paths: Sequence[Path], frames: FrameFormat, *, kind: Kind = "PSF", dark: Image | None = None
) -> FrameAverage:
    """Read and average frames of the same light, see `average_frames`."""
    stored = [frames.read_stored(path)[0] for path in paths]
    return average_frames(stored, frames, names=[path.name for path in paths], kind=kind, dark=dark)


def measure_sensor(files: SensorFiles, frames: FrameFormat, known: Corrections = Corrections()) -> SensorFrames:
    """Measure a sensor from dark and flat frames.

    Args:
        files: the frames.
        frames: format of the camera's frames; that of raw files with their mosaic.
        known: flat field and hot pixels of an earlier calibration, kept where no frames of this kind are given.

    Raises:
        MwdnError: a file cannot be read, frames of the same kind disagree, or flat frames show a pattern.
    """
    times: Sequence[float | None] = files.dark_exposures or (None,) * len(files.dark)
    darks = {time: average_files(group, frames, kind="dark") for time, group in zip(times, files.dark, strict=True)}
    measured = SensorFrames(darks, replace(known, psf_done=False), capture_exposure=files.capture_exposure)
    notes = [sentence for average in darks.values() for sentence in average.rejected.values()]
    if (longest := measured.longest_dark) is not None and longest.count > 1:
        defects = find_hot_pixels(longest, cell=frames.cell)
        measured = replace(measured, corrections=replace(measured.corrections, defects=defects))
    elif darks and known.defects is None:
        notes.append("A single dark frame cannot tell hot pixels from noise. Take several.")
    measured = replace(measured, notes=tuple(notes))
    return _with_flats(measured, files, frames) if files.flat else measured


def equal_parts(paths: Sequence[Path], count: int, kind: str) -> list[list[Path]]:
    """Divide files into consecutive groups of equal size.

    Raises:
        ParameterError: they cannot be divided.
    """
    if len(paths) % count:
        raise ParameterError(
            f"{kind[0].upper()}{kind[1:]} frames ({len(paths)}) cannot be divided into {count} equal groups. Give as "
            "many frames for each."
        )
    size = len(paths) // count
    return [list(paths[start : start + size]) for start in range(0, len(paths), size)]


def _with_flats(sensor: SensorFrames, files: SensorFiles, frames: FrameFormat) -> SensorFrames:
    dark_paths = files.flat_dark or tuple(chain(*files.dark))
    flats, darks = ([frames.read_stored(path)[0] for path in paths] for paths in (files.flat, dark_paths))
    names, defects, notes = [path.name for path in files.flat], sensor.corrections.defects, list(sensor.notes)
    dark = None
    if darks:
        dark = average_frames(darks, frames, names=[path.name for path in dark_paths], kind="dark").image
    else:
        notes.append("Without dark frames the flat field holds the black level, too: `--dark`.")
    flat, deviation, left_out = _mean_flat(flats, names, frames, dark)
    notes += left_out
    sensor.check_size(f"Flat frames, as `{names[0]}`", size_of(flat))
    defects = (torch.zeros(1, 1, *flat.shape[-2:]) > 0) if defects is None else defects
    plane, noise = flat.mean((0, 1)), deviation.mean((0, 1))
    if files.flat_field:
        _refuse_pattern(plane, frames.cell)
    defects = defects | find_dead_pixels(plane, noise, cell=frames.cell, through_mask=not files.flat_field)
    colour = demosaic(flat, frames.mosaic) if frames.mosaic else flat
    tint = tuple(colour.mean((0, 2, 3)).tolist()) if colour.shape[1] == 3 else ()
    transfer = None
    if len(flats) > 1 and len(darks) > 1 and frames.gamma is None:
        transfer = photon_transfer(flats, darks, frames, bad=defects, black=_black(sensor, defects))
    else:
        notes.append("Gain and read noise need two flat frames of the same exposure and two dark ones.")
    response = relative_response(flat, frames.cell) if files.flat_field else sensor.corrections.flat
    corrections = Corrections(response, defects)
    return replace(sensor, corrections=corrections, transfer=transfer, flat_colour=tint, notes=tuple(notes))


def _refuse_pattern(flat: Plane, cell: int) -> None:
    """Raise a `ParameterError` if more than `MAX_DEAD` of the pixels are unlike their neighbours, noise or not."""
    unlike = float(find_dead_pixels(flat, torch.zeros_like(flat), cell=cell).float().mean())
    if unlike > MAX_DEAD:
        raise ParameterError(
            f"{unlike:.0%} of the pixels of the flat frames are unlike their neighbours: the frames show a pattern, or "
            "are too dark. Take them of even light, a white page or the sky, at half of the full scale."
        )


def _black(sensor: SensorFrames, defects: Tensor) -> float | None:
    """Level without any light, as a fraction of the full scale: dark frames of several exposures, extrapolated to none.

    The light of the room, and dark current, grow with the exposure.
    """
    levels = {
        time: float(dark.image[(~defects).expand_as(dark.image)].double().mean())
        for time, dark in sensor.darks.items()
        if time is not None
    }
    if len(levels) < 2:
        return None
    times, means = (torch.tensor([*numbers], dtype=torch.float64) for numbers in (levels.keys(), levels.values()))
    # Fluctuations of the light are in proportion to it.
    return max(fit_line(times, means, 1 / times.square())[1], 0.0)


def _mean_flat(
    flats: Sequence[Frame], names: Sequence[str], frames: FrameFormat, dark: Image | None
) -> tuple[Image, Image, list[str]]:
    """Mean of flat frames over their levels, its standard deviation, and a sentence for each that is left out.

    Raises:
        ParameterError: all are saturated or dark.
    """
    levels = [float(frames.normalise(frame).mean()) - (0.0 if dark is None else float(dark.mean())) for frame in flats]
    total, variance, weight, notes = torch.zeros(1), torch.zeros(1), 0.0, list[str]()
    for start, stop in _runs(levels):
        average = average_frames(flats[start:stop], frames, names=names[start:stop], kind="flat", dark=dark)
        notes += average.rejected.values()
        if float(average.saturated.float().mean()) > 1e-3:
            notes.append(f"`{names[start]}` is saturated, and left out of the flat field.")
            continue
        # Relative to the level, noise falls with the square root of the electrons.
        part = average.count * levels[start]
        total = total + part * average.image / levels[start]
        noise = (average.noise or TYPICAL).variance(average.image) / average.count
        variance = variance + (part / levels[start]) ** 2 * noise
        weight += part
    if weight <= 0:
        raise ParameterError("All flat frames are saturated or dark. Expose them to about half of the full scale.")
    return total / weight, variance.sqrt() / weight, notes


def _runs(levels: Sequence[float]) -> list[tuple[int, int]]:
    """Start and stop of consecutive frames of the same light."""
    starts = [0] + [
        number
        for number in range(1, len(levels))
        if abs(levels[number] - levels[number - 1]) > SAME_LIGHT * abs(levels[number - 1])
    ]
    return list(zip(starts, [*starts[1:], len(levels)], strict=True))


def relative_response(flat: Image, cell: int) -> Tensor:
    """A flat frame over its mean, for each channel and each kind of pixel of a mosaic; at least `MIN_RESPONSE`."""
    response = torch.empty_like(flat)
    for row in range(cell):
        for column in range(cell):
            part = flat[..., row::cell, column::cell]
            response[..., row::cell, column::cell] = part / part.mean((-2, -1), keepdim=True).clamp(min=1e-12)
    return response.clamp(min=MIN_RESPONSE)
