"""Camera files: the calibration of a camera in one TOML file that people can read and edit."""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, get_type_hints

from mwdn.arguments import fits_type
from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.place_files import PlaceFiles
from mwdn.calibration.psf_format import PsfFormat
from mwdn.calibration.refinement import Refinement
from mwdn.calibration.white_balance import WhiteBalance
from mwdn.errors import ParameterError, PsfError, UnknownNameError, one_line, shown
from mwdn.io.files import as_parameter_error, atomic, file_sha256
from mwdn.io.headers import MAX_DECODED_BYTES
from mwdn.io.listing import FRAMES
from mwdn.io.toml import as_tuple, check_numbers, read_toml
from mwdn.optics.sensor import Sensor

_TYPES: dict[str, Any] = {
    **dict.fromkeys(("psf", "psf_sha256", "dark", "ambient", "flat_field", "hot_pixels"), str),
    "psf_corrected": bool,
    **get_type_hints(PsfFormat),
    **get_type_hints(FrameFormat),
    "white_balance": WhiteBalance,
    "pitch_um": float,
    "distance_mm": float,
    "dark_exposure": float,
    **dict.fromkeys(("electrons_per_count", "read_noise_electrons", "full_well_electrons", "black_level"), float),
    **dict.fromkeys(("distance_psfs", "field_psfs"), tuple[str, ...]),
    "distances_mm": tuple[float, ...],
    "field_positions": tuple[tuple[float, float], ...],
    **get_type_hints(Refinement),
}

KEYS: dict[str, tuple[str, Any]] = {
    "psf": ("Picture of a point source.", "psf.png"),
    "psf_sha256": ("SHA-256 of the PSF's file: once the file has changed, it is refused.", ""),
    "dark": ("Frame taken without light, subtracted from the PSF and the captures.", "dark.png"),
    "ambient": ("Frame taken with the room's light alone, subtracted from the captures.", "ambient.png"),
    "flat_field": ("Response of each pixel, by which the captures are divided.", "flat.tif"),
    "hot_pixels": ("Picture that is not black at defective pixels, which are replaced in the captures.", "hot.png"),
    "psf_corrected": ("The PSF's file has been corrected: no dark frame, flat field and hot pixels for it.", True),
    "background": ('Uniform light under the PSF, as a fraction of the full scale, or "estimate".', "estimate"),
    "psf_bin": ("`bin` of the PSF, if it was taken at another resolution than the captures.", 4),
    "psf_bit_depth": ("Bits of the PSF's numbers, if they are not those of the captures.", 8),
    "psf_gamma": ('Encoding of the PSF\'s file: "srgb", or a power such as 2.2. Linear unless given.', "srgb"),
    "psf_orientation": ("How the PSF must be turned to fit the captures.", "rotate-180"),
    "bgr": ("The files' channels are blue, green, red.", True),
    "bit_depth": ("Bits of the sensor, if its numbers do not fill the files' type.", 12),
    "gamma": ('Encoding of the captures: "srgb", or a power such as 2.2. Linear unless given.', "srgb"),
    "crop": ("Height and width of the central part to use, in raw pixels of the frame.", [1080, 1080]),
    "mosaic": ("Colours of the 2 x 2 cells of raw frames of a colour filter array.", "rggb"),
    "grey": ("Average the colours.", True),
    "bin": ("Average blocks of this many pixels along each axis. `mwdn reconstruct` chooses unless given.", 4),
    "upside_down": ("The files' first row is the bottom of the picture.", True),
    "white_balance": ('Of the pictures: "grey-world", "psf", or gains of red, green and blue.', "grey-world"),
    "pitch_um": ("Distance between pixels after binning, in micrometres.", 9.6),
    "distance_mm": ("Distance from the point source to the camera, in millimetres.", 200.0),
    "distance_psfs": ("PSFs of points at other distances, for `mwdn reconstruct --distance`.", ["near.tif"]),
    "distances_mm": ("Their distances, in millimetres.", [100.0]),
    "field_psfs": ("PSFs of points off the axis, each centred like the one on it, for simulation.", ["left.tif"]),
    "field_positions": ("Their displacements, down and right, in pixels of the raw frame.", [[0.0, -80.0]]),
    "electrons_per_count": ("Gain of the sensor: electrons for a step of its numbers.", 3.7),
    "read_noise_electrons": ("Noise of a pixel without light, a standard deviation.", 3.0),
    "full_well_electrons": ("Electrons at saturation.", 15000.0),
    "black_level": ("Mean of a dark frame, as a fraction of the full scale.", 0.01),
    "dark_exposure": ("Exposure of the dark frame, in milliseconds, if frames of the PSF had others.", 64.0),
    "psf_gain": ("Gain over the PSF of each colour: 1, y, x, y^2, yx, x^2 ... from -1 to 1.", [[1.0, 0.1, -0.1]]),
    "envelope_shift": ("Displacement of the aperture's shadow, down and right, over the shorter side.", [0.02, 0.0]),
    "sensor_field": ("Light that the sensor keeps, in the same terms; captures are divided by it.", [[1.0, 0.1, -0.1]]),
    "stray_light": ("Light without a scene, a fraction of the full scale; subtracted.", [[0.0, 0.01, 0.0]]),
}
"""Meaning and an example of each key, in the order of the file."""

MAX_LENGTH = 1e9
"""Largest `pitch_um` and `distance_mm`: 1 km and 1,000 km, beyond any lensless camera."""

_FILES = ("psf", "dark", "ambient", "flat_field", "hot_pixels")
_LISTS = ("distance_psfs", "field_psfs")
_POSITIVE = ("dark_exposure", "pitch_um", "distance_mm", "distances_mm", "electrons_per_count", "full_well_electrons")
_HEAD = """\
# A camera of mwdn: its PSF, and how its frames become measurements. Paths are relative to this file.
# Use it in any command: mwdn reconstruct CAPTURES --camera {name}
# Options on the command line take precedence; --mosaic none does without a key.
# To set a key that is a comment, remove its #.
"""


def read_camera(path: str | Path) -> dict[str, Any]:
    """Read the keys of a camera file; `mwdn.Calibration.load` makes a calibration of them.

    Returns:
        The values of the keys in the file, by the names of `KEYS`; paths include the folder of the camera file.

    Raises:
        ParameterError: the file cannot be read, names no PSF, or a value has another type.
        UnknownNameError: a key is none of `KEYS`.
    """
    path = Path(path)
    if path.suffix.lower() in FRAMES:
        raise ParameterError(f"`{path}` is a picture, but a camera file ends in .toml. Give it as the PSF: `--psf`.")
    if path.suffix.lower() == ".json":
        raise ParameterError(
            f"`{path}` is no camera file, which ends in .toml. Of `mwdn design`: `--psf psf.tif --background 0`."
        )
    table = read_toml(path, "camera file")
    for key, value in table.items():
        if key not in KEYS:
            raise UnknownNameError(f"key of the camera file `{path}`", key, KEYS)
        if not fits_type(value, _TYPES[key]):
            meaning, example = KEYS[key]
            raise ParameterError(
                f"`{key}` ({shown(value)}) in `{path}` must be like this: `{key} = {_to_toml(example)}`. {meaning}"
            )
        _check_range(key, value)
    if "psf" not in table:
        raise ParameterError(f'`{path}` must name the camera\'s PSF: `psf = "psf.png"`.')
    if table["psf"].lower().endswith(".toml"):
        raise ParameterError(f"`psf` ({shown(table['psf'])}) in `{path}` must be a picture, not a camera file.")
    files = {key: _file(path, table[key]) for key in _FILES if key in table}
    lists = {key: tuple(_file(path, name) for name in table[key]) for key in _LISTS if key in table}
    return {**{key: as_tuple(value) for key, value in table.items()}, **files, **lists}


def _file(path: Path, name: str) -> Path:
    """A file that the camera file names: beside it, or if it is a link, beside its target."""
    if "\0" in name:
        raise ParameterError(f"`{path}` names a file with a zero byte ({shown(name)}), which no file can have.")
    file = path.parent / name
    return file if not path.is_symlink() or os.path.lexists(file) else path.resolve().parent / name


def named_files(path: str | Path) -> dict[str, Path]:
    """The files that a camera file names, by their keys; those of a list have a number, too."""
    camera = read_camera(path)
    lists = {f"{key} {n}": file for key in _LISTS for n, file in enumerate(camera.get(key, ()), 1)}
    return {**{key: camera[key] for key in _FILES if key in camera}, **lists}


def _check_range(key: str, value: Any) -> None:  # noqa: ANN401
    """Raise a `ParameterError` if the number of a key, or one of its numbers, is outside its possible range."""
    check_numbers(value, key)
    for number in value if isinstance(value, list | tuple) else [value]:
        if key in _POSITIVE and not number > 0:
            raise ParameterError(f"`{key}` ({number}) must be positive.")
        if key == "read_noise_electrons" and not number >= 0:
            raise ParameterError(f"`{key}` ({number}) must not be negative.")
        if key == "black_level" and not 0 <= number < 1:
            raise ParameterError(f"`{key}` ({number}) must be in [0, 1), a fraction of the full scale.")


def with_changes(camera: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a camera file with some of them replaced; `pitch_um`, a distance after binning, follows `bin`."""
    changed = {**camera, **changes}
    bin = changed.get("bin", 1)
    if "pitch_um" in camera and "pitch_um" not in changes and isinstance(bin, int):  # another type is refused later
        changed["pitch_um"] = camera["pitch_um"] * bin / (camera.get("bin") or 1)
    return changed


def check_length(name: str, length: float | None) -> None:
    """Raise a `ParameterError` unless `pitch_um` or `distance_mm` is positive, and no longer than `MAX_LENGTH`."""
    if length is not None and not 0 < length <= MAX_LENGTH:
        raise ParameterError(f"`{name}` ({shown(length)}) must be above 0 and at most {MAX_LENGTH:g}.")


def pop_sensor(camera: dict[str, Any]) -> Sensor | None:
    """Remove the keys of the sensor from those of a camera file; ``None`` unless they have its noise.

    Raises:
        ParameterError: a number is out of its range.
    """
    names = ("electrons_per_count", "read_noise_electrons", "full_well_electrons", "black_level", "dark_exposure")
    gain, read_noise, full_well, black, _ = (camera.pop(name, None) for name in names)
    if read_noise is None or full_well is None:
        return None
    steps = full_well / gain if gain else 2**12 - 1  # the numbers between black and saturation
    bits = camera.get("bit_depth") or min(max(round(steps).bit_length(), 1), 16)
    return Sensor(full_well, read_noise, bits, black or 0.0)


def pop_places(camera: dict[str, Any]) -> PlaceFiles:
    """Remove the keys of PSFs at other places from those of a camera file.

    Raises:
        ParameterError: there are more files than places, or fewer.
    """
    places = {name: camera.pop(name, ()) for name in ("distances_mm", "distance_psfs", "field_positions", "field_psfs")}
    for names in (("distance_psfs", "distances_mm"), ("field_psfs", "field_positions")):
        files, numbers = (places[name] for name in names)
        if len(files) != len(numbers):
            raise ParameterError(f"`{names[0]}` ({len(files)}) must be as many as `{names[1]}` ({len(numbers)}).")
    return PlaceFiles(**places)


def write_camera(path: str | Path, camera: Mapping[str, Any]) -> None:
    """Write a camera file, atomically, with a line of explanation for each key.

    Args:
        path: ends in ``.toml``.
        camera: values by the names of `KEYS`; paths are relative to the current folder, and stored relative to the
            camera file. What is missing or ``None`` becomes a comment. The PSF's SHA-256 is added.

    Raises:
        ParameterError: another suffix, the file cannot be written, or it exists and is not a camera file.
    """
    path = Path(path)
    check_camera_path(path)
    values = {**camera, "psf_sha256": file_sha256(camera["psf"])}
    lines = []
    for key, (meaning, example) in KEYS.items():
        value = values.get(key)
        _check_range(key, [] if value is None else value)
        if key in _FILES and value is not None:
            value = _relative(Path(value), path.parent)
        elif key in _LISTS and value is not None:
            value = [_relative(Path(each), path.parent) for each in value]
        line = f"# {key} = {_to_toml(example)}" if value is None else f"{key} = {_to_toml(value)}"
        lines += ["", f"# {meaning}", line]
    with as_parameter_error(path.parent), atomic(path) as temporary:
        temporary.write_text(_HEAD.format(name=one_line(path.name)) + "\n".join(lines) + "\n", encoding="utf-8")


def check_camera_path(path: Path) -> None:
    """Raise a `ParameterError` if a camera file must not be written there: another suffix, or another kind of file."""
    if path.suffix.lower() != ".toml":
        raise ParameterError(f"`{path}` must end in .toml, not '{path.suffix}'. Rename it: `camera.toml`.")
    if path.exists() and not (path.is_file() and {"psf", "psf_sha256"} <= read_toml(path, "camera file").keys()):
        raise ParameterError(f"`{path}` is not a camera file and would be lost. Choose another name.")


def check_psf_file(path: str | Path, sha256: str, psf: Path) -> None:
    """Raise a `PsfError` if the PSF of the camera file ``path`` has changed since that was written."""
    # A larger file is refused when it is read; hashing it would take long.
    with suppress(OSError):  # an impossible file name; reading the file reports it
        if not sha256 or not psf.is_file() or psf.stat().st_size > MAX_DECODED_BYTES or file_sha256(psf) == sha256:
            return
        raise PsfError(
            f"`{psf}` has changed since the camera file `{path}` was written, and may not fit its other values. "
            f"Calibrate again: `mwdn calibrate --camera {path} -o {path}`."
        )


def _relative(path: Path, folder: Path) -> str:
    """A path as seen from a folder, with forward slashes; absolute if it is on another drive."""
    try:
        name = os.path.relpath(path, folder)
        if os.path.realpath(folder / name) != os.path.realpath(path):  # the folder is a link: `..` leads elsewhere
            name = os.path.relpath(path.parent.resolve() / path.name, folder.resolve())
        return Path(name).as_posix()
    except ValueError:
        return path.resolve().as_posix()


def _to_toml(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # which JSON allows
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ParameterError(f"`{value}` has a name that is not UTF-8, which TOML cannot hold. Rename it.") from None
    return text
