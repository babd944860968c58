"""`mwdn calibrate`: a PSF and everything else about a camera, as one file for the other commands."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from mwdn.calibration import Calibration, FrameFormat, PsfFormat
from mwdn.calibration.camera_file import check_camera_path, read_camera
from mwdn.calibration.camera_parts import draft_of, write_camera_with_parts
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.frame_format import changed_fields
from mwdn.calibration.photographs import CameraContent, calibrate_frames, expanded
from mwdn.calibration.report import inspect_psf
from mwdn.calibration.verdict import headline
from mwdn.calibration.watching import guide_exposure, watch_folder
from mwdn.calibration.white_balance import WhiteBalance, check_white_balance
from mwdn.cli.calibrate_checks import (
    PSF_OWN_FORMAT,
    check_bits,
    refuse_camera_files,
    refuse_corrected,
    refuse_psf_format,
    refuse_two_distances,
    refuse_with_watch,
)
from mwdn.cli.camera import CameraOptions
from mwdn.cli.inspect import load_at_psf_resolution
from mwdn.cli.photographs import WITHOUT, PhotographOptions
from mwdn.cli.refine import check_pair_file, refine
from mwdn.cli.session_frames import BenchFrames, bench_frames
from mwdn.cli.terminal import counted, if_interrupted, note, quoted, say
from mwdn.errors import ParameterError
from mwdn.io.files import file_sha256, refuse_overwrite

POLL_S = 0.3
"""Seconds between two looks at a watched folder."""

_ELSEWHERE = (("distance_psfs", "distances_mm"), ("field_psfs", "field_positions"))
"""Keys of the PSFs of points elsewhere, and of their places."""


def calibrate(  # noqa: PLR0913
    *files: Path,
    psf: Path | None = None,
    photographs: PhotographOptions = PhotographOptions(),
    frames: Annotated[FrameFormat, Parameter(name="*")] = FrameFormat(),
    psf_format: Annotated[PsfFormat, Parameter(name="*")] = PsfFormat(),
    ambient: None | Path = None,  # noqa: RUF036 - cyclopts tries None first, so that `--ambient none` is no path
    camera: Path | None = None,
    white_balance: WhiteBalance | Literal["flat"] | None = None,
    pitch_um: float | None = None,
    distance_mm: float | None = None,
    watch: Path | None = None,
    pairs: Path | None = None,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("camera.toml"),
    auto_bin: Annotated[bool, Parameter(show=False)] = True,
    auto_background: Annotated[bool, Parameter(show=False)] = True,
) -> None:
    """Write a camera file: the PSF, and everything else that other commands need to know about the camera.

    They take it as --camera camera.toml, or in place of the PSF. With --camera, this command changes an existing camera
    file. One picture of a point source is named by the file as it is. Several, with dark frames, are averaged, merged,
    corrected and centred, and the PSF is written beside the camera file.

    Args:
        files: pictures of a point source: frames of the camera, folders of them, or a session of `mwdn capture` whose
            recipe has `frames` of [point] (.h5, or its folder).
        psf: the picture of a point source, instead of FILES.
        photographs: exposures, and frames of other kinds.
        frames: format of the frames.
        psf_format: where the picture of the point source differs from the captures.
        ambient: frame taken with the room's light alone, subtracted from the captures.
        camera: camera file to change.
        white_balance: of the camera's pictures: grey-world, psf (the point source is white), flat (the light of the
            flat frames is white), or gains of red, green and blue.
        pitch_um: distance between pixels after binning, in micrometres.
        distance_mm: distance from the point source to the camera, in millimetres.
        watch: guide the exposure instead: for each frame that is written to this folder, print its peak, its saturated
            pixels and the exposure to use next.
        pairs: refine the calibration with a file of two or more pairs of this camera, from `mwdn align` or `mwdn
            import`: gain over the PSF, displacement of the aperture's shadow, field of the sensor, stray light.
        out: the camera file, ending in .toml.
        auto_bin: whether --bin is not given: then every reconstruction chooses.
        auto_background: whether --background is not given.
    """
    if watch is not None:
        refuse_with_watch(files, pairs)
        _watch(watch, frames, photographs.exposures)
        return
    check_camera_path(out)
    refuse_camera_files(files)
    pictures = [*files] or [CameraOptions(psf).psf_file]
    if pairs is not None:
        check_pair_file(pairs)
        refuse_overwrite(out, pairs)
    kept = _kept(camera)
    if files and psf not in (None, kept.get("psf")):
        raise ParameterError(f"`psf` (`{psf}`) is instead of FILES (`{files[0]}`). Give either of them.")
    if photographs.flat == WITHOUT:
        kept.pop("flat_field", None)
        photographs = replace(photographs, flat=())
    own_dark = kept.pop("dark", None)  # an option has it
    pictures = _by_kept_path(pictures, kept.get("psf"))
    photographs = replace(photographs, dark=tuple(_by_kept_path(photographs.dark, own_dark)))
    with bench_frames(BenchFrames(pictures, photographs, frames), own_dark) as bench:
        pictures, photographs, frames = bench.pictures, bench.photographs, bench.frames
        if photographs.dark_files != (own_dark,):
            kept.pop("dark_exposure", None)  # of another dark frame
        elif pictures != [kept["psf"]] and psf_format.shares_pixels(frames):
            photographs = _with_exposure(photographs, kept.get("dark_exposure"), camera)
        own = {
            "ambient": ambient,
            **_values(psf_format),
            **_values(frames),
            "background": kept.get("background") if auto_background else psf_format.background,
            "bin": None if auto_bin else frames.bin,
            "white_balance": white_balance,
            "pitch_um": pitch_um,
            "distance_mm": distance_mm,
        }
        check_bits(kept, own["bit_depth"], photographs, own_dark)
        if photographs.are_one_picture(pictures):
            dark = next(iter(expanded(photographs.dark_files)), None)
            options = CameraOptions(pictures[0], frames, psf_format=psf_format, dark=dark, ambient=ambient)
            refuse_overwrite(out, options.psf, dark, ambient)
            write = partial(_write_one_picture, options, kept, own)
        else:
            refuse_psf_format(psf_format, kept)
            refuse_two_distances(distance_mm, photographs.distances, kept)
            refuse_corrected(camera, kept, pictures)
            known = Corrections.read(kept.get("flat_field"), kept.get("hot_pixels"))
            refuse_overwrite(out, *expanded((*pictures, *photographs.dark_files, *photographs.flat)))
            done = calibrate_frames(photographs.of(pictures), frames, known)
            if auto_background and own["background"] == 0 and own_dark is not None and not photographs.dark_files:
                own["background"] = None  # 0 was for the dark frame
            write = partial(_write_photographs, done, {**kept, **own}, has_dark=bool(photographs.dark_files))
        _write_and_refine(out, pairs, write)


def _write_and_refine(out: Path, pairs: Path | None, write: Callable[[Path], tuple[str, Calibration]]) -> None:
    """Write the camera file, refined if there are pairs: it appears when it is complete and checked.

    Args:
        out: the camera file.
        pairs: to refine it with.
        write: writes it to a path; returns the PSF's verdict and the calibration.
    """
    interrupted = f"Interrupted. {out} is written at the end: nothing has changed."
    with if_interrupted(lambda: interrupted), draft_of(out) as draft:
        verdict, calibration = write(draft)
        if pairs is not None:
            refine(draft, pairs, out.with_name(f"{out.stem}-refinement.json"))
            calibration = Calibration.load(draft)
    _finish(verdict, calibration, out)


def _kept(camera: Path | None) -> dict[str, Any]:
    """The values of the camera file to change for which this command has no option."""
    values = {} if camera is None else read_camera(camera)
    psf, sha256 = values.get("psf"), values.pop("psf_sha256", "")
    if psf is not None and sha256 and psf.is_file() and file_sha256(psf) != sha256:
        values.pop("psf_corrected", None)  # the PSF has been replaced by another picture
    return values


def _values(format: PsfFormat | FrameFormat) -> dict[str, Any]:
    """The fields of a format; ``None`` for a default, which takes the key out of the camera file."""
    return dict.fromkeys(vars(format)) | changed_fields(format)


def _by_kept_path(files: Sequence[Path], kept: Path | None) -> list[Path]:
    """The files. If the only one is the camera file's own, its path as in the camera file, so that both are equal."""
    if kept is not None and [os.path.realpath(file) for file in files] == [os.path.realpath(kept)]:
        return [kept]
    return [*files]


def _with_exposure(photographs: PhotographOptions, exposure: float | None, camera: Path | None) -> PhotographOptions:
    """The photographs of a new PSF, with the exposure of the camera's dark frame; ``None`` is for any exposure.

    Raises:
        ParameterError: the photographs have another exposure, or none is given.
    """
    if exposure is None or photographs.dark_exposures:
        return photographs
    if photographs.exposures != (exposure,):
        given = ", ".join(f"{time:g}" for time in photographs.exposures) or "not given"
        raise ParameterError(
            f"The `exposures` of the PSF ({given}) must be that of the dark frame of `{camera}` ({exposure:g}), which "
            "is subtracted. If they differ, give dark frames for the PSF and for the captures: `dark` and "
            "`dark_exposures`."
        )
    return replace(photographs, dark_exposures=(exposure,))


def _write_one_picture(
    options: CameraOptions, kept: dict[str, Any], own: dict[str, Any], out: Path
) -> tuple[str, Calibration]:
    """Write a camera file that names the PSF's picture as it is; returns the PSF's verdict and the calibration."""
    if options.psf != kept.get("psf"):
        of_a_psf = {"psf_corrected", "psf_gain", "envelope_shift", *chain.from_iterable(_ELSEWHERE)}
        kept = {key: value for key, value in kept.items() if key not in of_a_psf}
    psf_done = kept.get("psf_corrected", False)
    corrections = Corrections.read(kept.get("flat_field"), kept.get("hot_pixels"), psf_done=psf_done)
    calibration = options.load(corrections)
    balance = own["white_balance"]
    if balance == "flat":
        raise ParameterError("`white_balance` 'flat' needs flat frames: `--flat`. Use 'grey-world', or gains.")
    check_white_balance(balance, calibration.light)
    own_resolution = load_at_psf_resolution(options, corrections)
    report = inspect_psf(own_resolution, own_resolution.frames.read(options.psf_file))
    write_camera_with_parts(out, {**kept, "psf": options.psf_file, "dark": options.dark, **own}, {})
    return headline(report), calibration


def _write_photographs(
    done: CameraContent, content: dict[str, Any], out: Path, *, has_dark: bool
) -> tuple[str, Calibration]:
    """Write a camera file with the pictures made of photographs; returns the PSF's verdict and the calibration."""
    if content.get("white_balance") == "flat":
        content["white_balance"] = _flat_balance(done.flat_colour)
    if content.get("background") is None and has_dark:
        # A dark frame with the room's light has no background left; tails below the lines are then the PSF's own.
        content["background"] = 0.0
    content |= dict.fromkeys((*PSF_OWN_FORMAT, "psf_gain", "envelope_shift"))  # of an earlier PSF
    content |= done.content
    for psfs, places in _ELSEWHERE:  # those of an earlier PSF do not fit this one
        if psfs not in done.parts:
            content |= {psfs: None, places: None}
    written = write_camera_with_parts(out, content, done.parts)
    calibration = Calibration.load(out)
    check_white_balance(calibration.white_balance, calibration.light)
    verdict = headline(inspect_psf(calibration, calibration.frames.read(written["psf"])))
    note(*done.notes)
    say(*done.results)
    return verdict, calibration


def _flat_balance(colour: tuple[float, ...]) -> tuple[float, float, float]:
    """Gains that make the light of the flat frames white."""
    if len(colour) != 3 or min(colour) <= 0:
        raise ParameterError(
            "`white_balance` 'flat' needs flat frames in colour: `--flat`. Use 'grey-world', or gains."
        )
    red, green, blue = colour
    return round(green / red, 4), 1.0, round(green / blue, 4)


def _finish(verdict: str, calibration: Calibration, out: Path) -> None:
    height, width = calibration.size
    say(
        verdict,
        f"PSF {calibration.psf_hash}, {height} x {width} pixels. More about it: mwdn inspect --camera {quoted(out)}",
        f"Use it: mwdn reconstruct CAPTURES --camera {quoted(out)}",
    )


def _watch(folder: Path, frames: FrameFormat, exposures: tuple[float, ...]) -> None:
    """Print a line for each new frame, until Ctrl-C."""
    count = 0

    def wait() -> bool:
        time.sleep(POLL_S)
        return True

    say(f"Watching {folder}: save frames there. Ctrl-C ends.")
    with if_interrupted(lambda: f"Stopped after {counted(count, 'frame')}."):
        exposure = exposures[0] if len(exposures) == 1 else None
        for sentence, _ in guide_exposure(watch_folder(folder, frames, wait), frames, exposure_ms=exposure):
            count += 1
            say(sentence)
