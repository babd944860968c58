"""`mwdn calibrate`: a PSF and everything else about a camera, as one file for the other commands."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from mwdn.calibration import FrameFormat, PsfFormat
from mwdn.calibration.camera_file import check_camera_path, write_camera
from mwdn.calibration.report import inspect_psf
from mwdn.calibration.verdict import headline
from mwdn.calibration.white_balance import WhiteBalance, check_white_balance
from mwdn.cli.camera import CameraOptions
from mwdn.cli.inspect import at_psf_resolution
from mwdn.cli.terminal import say
from mwdn.io.files import refuse_overwrite


def calibrate(
    camera: CameraOptions = CameraOptions(),
    *,
    white_balance: WhiteBalance | None = None,
    pitch_um: float | None = None,
    distance_mm: float | None = None,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("camera.toml"),
    auto_bin: Annotated[bool, Parameter(show=False)] = True,
) -> None:
    """Write a camera file: the PSF, and everything else that other commands need to know about the camera.

    They take it as --camera camera.toml. With --camera, this command changes an existing camera file.

    Args:
        camera: the PSF and its format.
        white_balance: of the camera's pictures: grey-world, psf (the point source is white), or gains of red, green and
            blue.
        pitch_um: distance between pixels after binning, in micrometres.
        distance_mm: distance from the point source to the camera, in millimetres.
        out: the camera file, ending in .toml.
        auto_bin: whether --bin is not given: then every reconstruction chooses.
    """
    check_camera_path(out)
    refuse_overwrite(out, camera.psf, camera.dark, camera.ambient)
    fresh = replace(camera, camera=None)  # a changed PSF is what this command is for
    calibration = fresh.load()
    check_white_balance(white_balance, calibration.light)
    own_resolution = at_psf_resolution(fresh).load()
    report = inspect_psf(own_resolution, own_resolution.frames.read(fresh.psf_file))
    content = {
        "psf": fresh.psf_file,
        "dark": camera.dark,
        "ambient": camera.ambient,
        **_changes(camera.psf_format),
        **_changes(camera.frames),
        "bin": None if auto_bin else camera.frames.bin,
        "white_balance": white_balance,
        "pitch_um": pitch_um,
        "distance_mm": distance_mm,
    }
    write_camera(out, content)
    height, width = calibration.size
    say(
        headline(report),
        f"PSF {calibration.psf_hash}, {height} x {width} pixels. More about it: mwdn inspect --camera {out}",
        f"Use it: mwdn reconstruct CAPTURES --camera {out}",
    )


def _changes(format: FrameFormat | PsfFormat) -> dict[str, Any]:
    """The fields that differ from their defaults."""
    defaults = vars(type(format)())
    return {name: value for name, value in vars(format).items() if value != defaults[name]}
