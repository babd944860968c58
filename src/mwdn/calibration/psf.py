"""The calibration of a camera: its PSF, and the format of its raw frames."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mwdn.arguments import check_batch, checked
from mwdn.calibration.ambient_frame import denoise_ambient
from mwdn.calibration.camera_file import check_length, check_psf_file, pop_places, pop_sensor, read_camera, with_changes
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.float_scale import check_float_scale
from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.place_files import PlaceFiles
from mwdn.calibration.psf_format import PsfFormat, current_options, with_options
from mwdn.calibration.psf_levels import background_level, check_light, check_psf_frame
from mwdn.calibration.refinement import TERMS, Refinement
from mwdn.calibration.size_advice import advise_size
from mwdn.calibration.white_balance import WhiteBalance, check_white_balance
from mwdn.errors import ParameterError, PsfError, ShapeError, shown
from mwdn.io.arrays import as_frame
from mwdn.optics.psf import checked_psf, psf_hash
from mwdn.optics.sensor import Sensor
from mwdn.types import ArrayPicture, Frame, Image, Measurement, Psf, Size, size_of


@checked
@dataclass(frozen=True, eq=False)
class Calibration:
    """A PSF, and how raw frames of its camera become measurements.

    Args:
        psf: (1, C, H, W), not negative, centred at ``(H // 2, W // 2)``. Each channel is scaled to unit sum.
        frames: format of raw frames.
        dark: (1, C or 1, h, w), raw frame taken without light, as a fraction of the full scale.
        background: level that was subtracted from each channel of the PSF, as a fraction of the full scale.
        pitch_um: distance between pixels after binning.
        distance_mm: distance from the point source to the camera.
        ambient: (1, C or 1, h, w), raw frame taken with the room's light alone, as a fraction of the full scale.
        psf_format: where the PSF's file differed from the captures.
        light: sum of each channel of the PSF before it was normalised: the colour of the point source.
        white_balance: of the camera's pictures; `mwdn.Reconstructor` applies it.
        corrections: flat field and hot pixels, corrected in each frame.
        sensor: noise and saturation of the sensor's own pixels, if they were measured; see `binned_sensor`.
        places: files of PSFs at other distances and positions, see `mwdn.calibration.places`.
        refinement: terms found with known pictures, see `refined`.
        unrefined_hash: `psf_hash` before the refinement; empty without one.

    Raises:
        PsfError: the PSF has wrong axes, or is negative, not finite, or dark.
        ParameterError: an argument is of another type or outside its range.
    """

    psf: Psf
    frames: FrameFormat = FrameFormat()
    dark: Tensor | None = None
    background: tuple[float, ...] = ()
    pitch_um: float | None = None
    distance_mm: float | None = None
    ambient: Tensor | None = None
    psf_format: PsfFormat = PsfFormat()
    light: tuple[float, ...] = ()
    white_balance: WhiteBalance | None = None
    corrections: Corrections = Corrections()
    sensor: Sensor | None = None
    places: PlaceFiles = PlaceFiles()
    refinement: Refinement = Refinement()
    unrefined_hash: str = ""

    @classmethod
    @checked
    def load(cls, path: str | Path, **options: Any) -> "Calibration":  # noqa: ANN401
        """Read a camera file, as `mwdn calibrate` writes it.

        Args:
            path: the camera file, see `mwdn.calibration.camera_file`.
            **options: values that replace those of the file: ``bin=4``, ``psf="other.png"``.

        Raises:
            PsfError: as for `from_file`; or the PSF's file has changed since the camera file was written.
            MwdnError: as for `from_file`, and for a camera file with wrong keys or values.
        """
        camera = read_camera(path)
        sha256, own_psf = camera.pop("psf_sha256", ""), camera["psf"]
        camera = with_changes(camera, current_options(options))
        terms = Refinement(**{name: camera.pop(name) for name in TERMS if name in camera})
        if Path(camera["psf"]).resolve() == own_psf.resolve():
            check_psf_file(path, sha256, own_psf)
        else:  # nothing is known about another PSF file
            camera["psf_corrected"] = options.get("psf_corrected", False)
            terms = replace(terms, psf_gain=(), envelope_shift=None)
            pop_places(camera)
        extra = {name: camera.pop(name, None) for name in ("white_balance", "pitch_um", "distance_mm")}
        extra |= {"sensor": pop_sensor(camera), "places": pop_places(camera)}
        files = (camera.pop(name, None) for name in ("flat_field", "hot_pixels"))
        corrections = Corrections.read(*files, psf_done=camera.pop("psf_corrected", False))
        calibration = cls.from_file(camera.pop("psf"), corrections=corrections, **camera)
        return replace(calibration, **extra).refined(terms)

    def refined(self, refinement: Refinement) -> "Calibration":
        """Apply a refinement to a calibration that has none yet: to its PSF and to all measurements."""
        if not refinement:
            return self
        return replace(self, psf=refinement.psf(self.psf), refinement=refinement, unrefined_hash=self.psf_hash)

    @classmethod
    @checked
    def from_file(
        cls,
        path: str | Path,
        frames: FrameFormat = FrameFormat(),
        *,
        psf_format: PsfFormat = PsfFormat(),
        dark: str | Path | None = None,
        ambient: str | Path | None = None,
        corrections: Corrections = Corrections(),
        **options: Any,  # noqa: ANN401
    ) -> "Calibration":
        """Read the picture of a point source, or a camera file.

        Args:
            path: PNG, TIFF or NPY of 8 to 16 bits or floats, grey or colour; a camera's raw file; or a ``.toml`` for
                `load`, where only options that differ are given.
            frames: format of the PSF, the other frames and the captures; a raw file of the PSF adds its mosaic.
            psf_format: where the PSF's file differs from it.
            dark: frame taken with the same exposure and no light; subtracted from the PSF and from captures.
            ambient: frame of the room's light alone, with the captures' exposure; subtracted from captures alone.
            corrections: flat field and hot pixels; not for a camera file, which has its own.
            **options: fields of `FrameFormat` and `PsfFormat`, which replace those of ``frames`` and ``psf_format``:
                ``bin=4, bit_depth=12, gamma="srgb", background=0.0, psf_bin=8``.

        Raises:
            ImageError: a file cannot be read.
            PsfError: the PSF is saturated, empty, or has neither 1 nor 3 channels.
            ShapeError: the dark frame does not fit, or a mosaic has colours or odd sides.
            ParameterError: a number is outside its range.
            UnknownNameError: an option has another name.
        """
        if Path(path).suffix.lower() == ".toml":
            has_corrections = corrections.flat is not None or corrections.defects is not None
            if frames != FrameFormat() or psf_format != PsfFormat() or has_corrections:
                raise ParameterError(f"`{path}` has its own format and `corrections`. Give what differs: `bin=4`.")
            frame_files = {"dark": dark, "ambient": ambient}
            return cls.load(path, **options, **{name: file for name, file in frame_files.items() if file is not None})
        frames, psf_format = with_options(frames, psf_format, options)
        frame, frames = frames.read_stored(path)
        dark_frame, room_frame = (None if file is None else frames.read(file) for file in (dark, ambient))
        return cls._from_frame(frame, frames, psf_format, dark=dark_frame, ambient=room_frame, corrections=corrections)

    @classmethod
    def from_array(
        cls,
        picture: ArrayPicture,
        frames: FrameFormat = FrameFormat(),
        *,
        psf_format: PsfFormat = PsfFormat(),
        dark: ArrayPicture | None = None,
        ambient: ArrayPicture | None = None,
        **options: Any,  # noqa: ANN401
    ) -> "Calibration":
        """Calibrate from a numpy array or PIL picture of a point source.

        Args:
            picture: (H, W) or (H, W, 1 or 3), RGB, rows as for `correct`; linear in light without ``psf_gamma``.
                uint8 and uint16 saturate at their type's maximum unless ``bit_depth`` is given; floats have any scale.
            frames: as for `from_file`, as are the other arguments.
            psf_format: where the PSF's picture differs from it.
            dark: frame taken with the same exposure and no light.
            ambient: frame taken with the room's light alone.
            **options: fields of `FrameFormat` and `PsfFormat`.

        Raises:
            ImageError: the array has other axes or numbers.
            MwdnError: as for `from_file`.
        """
        frames, psf_format = with_options(frames, psf_format, options)
        dark, ambient = (None if frame is None else as_frame(frame) for frame in (dark, ambient))
        return cls._from_frame(as_frame(picture), frames, psf_format, dark=dark, ambient=ambient)

    @classmethod
    def _from_frame(
        cls,
        frame: Frame,
        frames: FrameFormat,
        psf_format: PsfFormat,
        *,
        dark: Frame | None,
        ambient: Frame | None,
        corrections: Corrections = Corrections(),
    ) -> "Calibration":
        check_psf_frame(psf_format.own_frames(frames), frame)
        dark_image, room = frames.offset(dark, "dark"), frames.offset(ambient, "ambient")
        draft = cls(
            torch.ones(1, 1, 1, 1), frames, dark_image, ambient=room, psf_format=psf_format, corrections=corrections
        )
        psf = draft.psf_image(frame)
        level = background_level(psf, psf_format.background)
        psf = (psf - level).clamp(min=0)
        total = psf.sum((-2, -1), keepdim=True)
        check_light(total.flatten(), level.flatten(), with_dark=dark is not None)
        background = tuple(round(float(value), 6) for value in level.flatten())
        light = tuple(total.flatten().tolist())
        return replace(draft, psf=psf_format.turn(psf / total, frames), background=background, light=light)

    def psf_image(self, frame: Frame) -> Image:
        """The PSF's own raw frame as an image (1, C, H, W): corrected, cropped and binned, not yet turned."""
        own_frames = self.psf_format.own_frames(self.frames)
        if self.corrections.psf_done or not self.psf_format.shares_pixels(self.frames):
            return own_frames.to_measurement(frame)
        if self.dark is not None:
            check_float_scale(frame, own_frames.bit_depth, of="`psf`, from which `dark` is subtracted,")
        return own_frames.to_measurement(frame, self.dark, self.corrections)

    def __post_init__(self) -> None:
        if not isinstance(self.psf, Tensor):
            raise ParameterError(
                f"`psf` ({shown(self.psf)}) must be a tensor (1, C, H, W). `Calibration.from_array(picture)` takes a "
                "numpy array or PIL picture of a point source, `Calibration.from_file('psf.png')` a file."
            )
        if self.psf.ndim != 4 or self.psf.shape[0] != 1 or self.psf.shape[1] not in (1, 3) or 0 in self.psf.shape:
            raise PsfError(f"`psf` {tuple(self.psf.shape)} must be (1, 1 or 3, H, W): grey or RGB.")
        object.__setattr__(self, "psf", checked_psf(self.psf).float())
        for name, frame in (("dark", self.dark), ("ambient", self.ambient)):
            if frame is not None:
                check_batch(frame, name)
        check_white_balance(self.white_balance, self.light)
        check_length("pitch_um", self.pitch_um)
        check_length("distance_mm", self.distance_mm)

    def __repr__(self) -> str:
        colours = "RGB" if self.psf.shape[1] == 3 else "grey"
        return f"Calibration({self.size[0]} x {self.size[1]}, {colours}, PSF {self.psf_hash}, {self.frames})"

    @cached_property
    def psf_hash(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of the PSF's shape and float32 numbers."""
        return psf_hash(self.psf)

    @cached_property
    def offset(self) -> Tensor | None:
        """What is subtracted from raw captures: the dark frame, or the ambient frame without its noise."""
        return self.dark if self.ambient is None else denoise_ambient(self.ambient, self.dark, self.frames.cell)

    @property
    def size(self) -> Size:
        """Height and width of the PSF and of a measurement."""
        return size_of(self.psf)

    @property
    def binned_sensor(self) -> Sensor | None:
        """The sensor of a measurement's pixels."""
        return self.sensor and self.sensor.binned(self.frames.bin)

    def saturated_part(self, frame: ArrayPicture) -> float:
        """Fraction of a raw frame's pixels that are saturated; 0 for floats, which have no known maximum."""
        frame = as_frame(frame, finite=False)
        return self.frames.saturated(frame)[0] / (frame.shape[0] * frame.shape[1])

    def correct(self, frame: ArrayPicture) -> Measurement:
        """Turn a raw frame into a measurement of the PSF's size.

        Args:
            frame: (H, W) or (H, W, 1 or 3) raw pixel values: from `FrameFormat.read`, or another array or PIL picture.
                RGB, row 0 at the top; with `FrameFormat.upside_down` at the bottom, and turned here. Without a
                ``bit_depth`` integers saturate at their type's maximum, floats at 1; without a ``gamma`` all is linear.

        Returns:
            (1, C, *size), linear light; 1 is saturation.

        Raises:
            ShapeError: the frame does not fit the PSF.
            ImageError: the array has other axes or types.
            ParameterError: a pixel value exceeds the bit depth, or floats exceed 1 by far.
        """
        measurement = self.to_measurement(frame)
        self.check_fit(measurement)
        return measurement

    def to_measurement(self, frame: ArrayPicture) -> Measurement:
        """Turn a raw frame into a measurement of the frame's own size: `correct` without `check_fit`."""
        frame = as_frame(frame, finite=False)
        check_float_scale(frame, self.frames.bit_depth)
        return self.refinement.measurement(self.frames.to_measurement(frame, self.offset, self.corrections.of_capture))

    def check_fit(self, measurement: Measurement) -> None:
        """Raise a `ShapeError` unless the measurement (1, C, H, W) has the PSF's size, and colours if the PSF has."""
        size = size_of(measurement)
        if size != self.size:
            raise ShapeError(
                f"`psf` ({self.size[0]} x {self.size[1]}) and the capture ({size[0]} x {size[1]}) must have the same "
                f"height and width. {advise_size(size, self.size, self.frames, self.psf_format)}"
            )
        if measurement.shape[1] == 1 and self.psf.shape[1] == 3:
            raise ShapeError(
                "The capture is grey, but `psf` has colours. Use both as grey: `grey=True`. For the raw frame of a "
                "colour sensor, give the order of its filters: `mosaic='rggb'`."
            )
