"""Options of the camera, shared by most commands."""

from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mwdn.calibration import Calibration, FrameFormat, PsfFormat
from mwdn.calibration.camera_file import named_files
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.places import at_distance
from mwdn.cli.terminal import detail, note
from mwdn.errors import ParameterError


@Parameter(name="*")
@dataclass(frozen=True)
class CameraOptions:
    """The camera's PSF and the format of its raw frames, or the file that holds them.

    Args:
        psf: picture of a point source: PNG, TIFF, NPY or a camera's raw file.
        frames: format of the PSF, the dark frame and the captures.
        psf_format: where the PSF's file differs from it.
        dark: frame taken without light, subtracted from the PSF and the captures.
        ambient: frame taken with the room's light alone, subtracted from the captures.
        camera: camera file of `mwdn calibrate`, with all of these; options on the command line take precedence:
            --mosaic none, --dark none ... do without what the file says.
        distance: of the scene in millimetres, for a camera with PSFs at several distances.
    """

    psf: Path | None = None
    frames: Annotated[FrameFormat, Parameter(name="*")] = FrameFormat()
    _: KW_ONLY
    psf_format: Annotated[PsfFormat, Parameter(name="*")] = PsfFormat()
    dark: None | Path = None  # noqa: RUF036 - cyclopts tries None first, so that `--dark none` is no path
    ambient: None | Path = None  # noqa: RUF036
    camera: Path | None = None
    distance: float | None = None

    @cached_property
    def roles(self) -> dict[str, Path]:
        """Files that describe the camera, by what they are; the camera file is read once."""
        files = {"PSF": self.psf, "dark frame": self.dark, "ambient frame": self.ambient, "camera file": self.camera}
        if self.camera is not None:
            files |= {f"{name} of the camera file": path for name, path in named_files(self.camera).items()}
        return {role: path for role, path in files.items() if path is not None}

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that describe the camera: never captures, never overwritten."""
        return tuple(self.roles.values())

    @property
    def psf_file(self) -> Path:
        """The PSF's file, from the command line or the camera file.

        Raises:
            ParameterError: neither was given.
        """
        if self.psf is None:
            raise ParameterError("Give the camera's PSF, `--psf psf.png`, or its camera file, `--camera camera.toml`.")
        return self.psf

    def load(self, corrections: Corrections = Corrections(), *, psf_done: bool = False) -> Calibration:
        """The calibration of `read`, whose sentence is printed."""
        calibration, sentence = self.read(corrections, psf_done=psf_done)
        note(*filter(None, [sentence]))
        return calibration

    def read(self, corrections: Corrections = Corrections(), *, psf_done: bool = False) -> tuple[Calibration, str]:
        """Read the calibration.

        Args:
            corrections: flat field and hot pixels, for a camera without a camera file.
            psf_done: no flat field and hot pixels for the PSF's file, whatever the camera file says.

        Returns:
            The calibration, and a sentence about the PSF of `distance`, empty without one.

        Raises:
            ParameterError: no PSF is given.
            MwdnError: a file cannot be read, or does not fit.
        """
        formats = {**vars(self.frames), **vars(self.psf_format)}
        detail(f"{self.psf_file}: {', '.join(f'{name} {value}' for name, value in formats.items())}")
        options = {"dark": self.dark, "ambient": self.ambient, **formats}
        if self.camera is None:
            corrections = replace(corrections, psf_done=psf_done or corrections.psf_done)
            calibration = Calibration.from_file(self.psf_file, corrections=corrections, **options)
        else:
            options |= {"psf_corrected": True} if psf_done else {}
            calibration = Calibration.load(self.camera, psf=self.psf_file, **options)
        return (calibration, "") if self.distance is None else at_distance(calibration, self.distance)
