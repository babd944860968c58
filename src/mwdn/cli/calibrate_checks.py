"""Checks of `mwdn calibrate` that its options belong together."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mwdn.calibration import PsfFormat
from mwdn.cli.photographs import PhotographOptions
from mwdn.errors import ParameterError

PSF_OWN_FORMAT = ("psf_bin", "psf_bit_depth", "psf_gamma", "psf_orientation")
"""Keys of a PSF whose picture is of another format than the captures."""


def check_bits(before: dict[str, Any], bits: int | None, photographs: PhotographOptions) -> None:
    """Refuse other bits than those of the sensor's measurement, whose levels are fractions of the full scale."""
    measured, is_dark_new = before.get("bit_depth"), photographs.dark_files not in ((), (before.get("dark"),))
    stale = ("full_well_electrons" in before and not photographs.flat) or ("black_level" in before and not is_dark_new)
    if bits != measured and stale:
        raise ParameterError(
            f"`bit_depth` ({bits or 'none'}) must be {measured or 'left out'}, as the sensor was measured. To change "
            "it, give dark and flat frames, too, which measure it again."
        )


def refuse_with_watch(files: Sequence[Path], pairs: Path | None) -> None:
    """Refuse pictures and pairs where frames are only watched."""
    if files or pairs is not None:
        given = f"`{files[0]}`" if files else f"`pairs` (`{pairs}`)"
        raise ParameterError(f"`watch` guides the exposure and writes no camera file: leave out {given}.")


def refuse_camera_files(files: Sequence[Path]) -> None:
    """Refuse a camera file among the pictures."""
    for file in files:
        if file.suffix.lower() == ".toml":
            raise ParameterError(f"`{file}` is a camera file, not a picture. To change it, give it as `camera`.")


def refuse_two_psfs(files: Sequence[Path], psf: Path | None, before: dict[str, Any]) -> None:
    """Refuse a PSF beside pictures of the point source, unless it is the camera file's."""
    if files and psf not in (None, before.get("psf")):
        raise ParameterError(f"`psf` (`{psf}`) is instead of FILES (`{files[0]}`). Give either of them.")


def refuse_psf_format(psf_format: PsfFormat, before: dict[str, Any]) -> None:
    """Refuse a format of the PSF's own for several frames, unless it is that of the camera file's earlier PSF."""
    for name in PSF_OWN_FORMAT:
        if getattr(psf_format, name) not in (None, before.get(name)):
            raise ParameterError(
                f"`{name}` is for one picture from another source. Frames of the camera itself have the captures' "
                "format (`bin`, `bit_depth`, `gamma`): leave it out."
            )


def refuse_two_distances(distance_mm: float | None, distances: Sequence[float], before: dict[str, Any]) -> None:
    """Refuse another distance of the camera's own PSF than that of its frames."""
    if distances and distance_mm not in (None, before.get("distance_mm"), distances[0]):
        raise ParameterError(
            f"`distance_mm` ({distance_mm:g}) must be the first of `distances` ({distances[0]:g}): leave it out."
        )


def refuse_corrected(camera: Path | None, before: dict[str, Any], pictures: Sequence[Path]) -> None:
    """Refuse to correct a PSF twice."""
    if before.get("psf_corrected") and [*pictures] == [before["psf"]]:
        raise ParameterError(
            f"The PSF of `{camera}` is corrected already. To correct it by other frames, name the photographs of the "
            "point source again, with all that belong to them: `mwdn calibrate POINT --dark DARK ...`."
        )
