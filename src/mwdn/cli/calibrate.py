"""`mwdn calibrate`: a PSF and everything else about a camera, as one file for the other commands."""

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from mwdn.calibration import Calibration, FrameFormat, PsfFormat
from mwdn.calibration.camera_file import check_camera_path, read_camera
from mwdn.calibration.camera_parts import draft_of, write_camera_with_parts
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.frame_format import changed_fields
from mwdn.calibration.photographs import CameraContent, calibrate_frames, expanded
from mwdn.calibration.psf_format import Background
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
    refuse_two_psfs,
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

_PSF_KEYS = (
    *("psf_corrected", "psf_gain", "envelope_shift"),
    *("distance_psfs", "distances_mm", "field_psfs", "field_positions"),
)
"""Keys of a camera file that do not hold for another PSF."""

_Inspected = tuple[str, Calibration]
"""Verdict on a PSF, and the calibration."""


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
    before = _read_before(camera)
    refuse_two_psfs(files, psf, before)
    given = _by_own_paths(BenchFrames(pictures, photographs, frames), before)
    interrupted = f"Interrupted. {out} is written at the end: nothing has changed."
    with if_interrupted(lambda: interrupted), bench_frames(given, before.get("dark")) as recorded:
        bench = _with_dark_exposure(recorded, psf_format, before, camera)
        check_bits(before, bench.frames.bit_depth, bench.photographs)
        content = {  # `None` removes a key
            **before,
            "dark": None,  # `bench` names it
            "dark_exposure": before.get("dark_exposure") if _keeps_dark(bench, before) else None,
            "flat_field": None if photographs.flat == WITHOUT else before.get("flat_field"),
            **_values(psf_format),
            **_values(bench.frames),
            "ambient": ambient,
            "background": _background(bench, before) if auto_background else psf_format.background,
            "bin": None if auto_bin else bench.frames.bin,
            "white_balance": white_balance,
            "pitch_um": pitch_um,
            "distance_mm": distance_mm,
        }
        inspected = None
        if bench.photographs.are_one_picture(bench.pictures):
            new, inspected = _name_picture(bench, psf_format, content, out)
        else:
            refuse_psf_format(psf_format, before)
            refuse_two_distances(distance_mm, bench.photographs.distances, before)
            refuse_corrected(camera, before, bench.pictures)
            new = _average(bench, content, out)
        _write(out, new, inspected, pairs)


def _read_before(camera: Path | None) -> dict[str, Any]:
    """The values of the camera file to change; none without one."""
    values = {} if camera is None else read_camera(camera)
    psf, sha256 = values.get("psf"), values.pop("psf_sha256", "")
    if psf is not None and sha256 and psf.is_file() and file_sha256(psf) != sha256:
        values.pop("psf_corrected", None)  # the PSF has been replaced by another picture
    return values


def _by_own_paths(given: BenchFrames, before: dict[str, Any]) -> BenchFrames:
    """The frames, named as in the camera file where they are its own; no flat frames for `WITHOUT`."""
    dark = tuple(_by_own_path(given.photographs.dark, before.get("dark")))
    flat = () if given.photographs.flat == WITHOUT else given.photographs.flat
    photographs = replace(given.photographs, dark=dark, flat=flat)
    return BenchFrames(_by_own_path(given.pictures, before.get("psf")), photographs, given.frames)


def _by_own_path(files: Sequence[Path], own: Path | None) -> list[Path]:
    """The files; if the only one is the camera file's own, its path as in the camera file."""
    if own is not None and [os.path.realpath(file) for file in files] == [os.path.realpath(own)]:
        return [own]
    return [*files]


def _keeps_dark(bench: BenchFrames, before: dict[str, Any]) -> bool:
    """Whether the dark frame is that of the camera file."""
    return bench.photographs.dark_files == (before.get("dark"),)


def _with_dark_exposure(
    bench: BenchFrames, psf_format: PsfFormat, before: dict[str, Any], camera: Path | None
) -> BenchFrames:
    """The frames; those of a new PSF with the exposure of the camera file's dark frame, if that is subtracted.

    Raises:
        ParameterError: they have another exposure, or none is given.
    """
    exposure, photographs = before.get("dark_exposure"), bench.photographs
    is_subtracted = _keeps_dark(bench, before) and psf_format.shares_pixels(bench.frames)
    is_new = bench.pictures != [before.get("psf")]
    if exposure is None or photographs.dark_exposures or not (is_subtracted and is_new):
        return bench
    if photographs.exposures != (exposure,):
        given = ", ".join(f"{time:g}" for time in photographs.exposures) or "not given"
        raise ParameterError(
            f"The `exposures` of the PSF ({given}) must be that of the dark frame of `{camera}` ({exposure:g}), which "
            "is subtracted. If they differ, give dark frames for the PSF and for the captures: `dark` and "
            "`dark_exposures`."
        )
    return replace(bench, photographs=replace(photographs, dark_exposures=(exposure,)))


def _values(format: PsfFormat | FrameFormat) -> dict[str, Any]:
    """The fields of a format; ``None`` for a default, which takes the key out of the camera file."""
    return dict.fromkeys(vars(format)) | changed_fields(format)


def _background(bench: BenchFrames, before: dict[str, Any]) -> Background | None:
    """The background if no option gives it: that of averaged frames, if 0, comes and goes with the dark frame."""
    background: Background | None = before.get("background")
    if bench.photographs.are_one_picture(bench.pictures):
        return background
    if bench.photographs.dark_files:
        # A dark frame with the room's light has no background left; tails below the lines are then the PSF's own.
        return 0.0 if background is None else background
    return None if background == 0 and "dark" in before else background


def _name_picture(
    bench: BenchFrames, psf_format: PsfFormat, content: dict[str, Any], out: Path
) -> tuple[CameraContent, _Inspected]:
    """A camera file that names the PSF's picture as it is."""
    dark, ambient = next(iter(expanded(bench.photographs.dark_files)), None), content["ambient"]
    options = CameraOptions(bench.pictures[0], bench.frames, psf_format=psf_format, dark=dark, ambient=ambient)
    refuse_overwrite(out, options.psf, dark, ambient)
    if options.psf != content.get("psf"):
        content = {**content, **dict.fromkeys(_PSF_KEYS)}
    psf_done = bool(content.get("psf_corrected"))
    corrections = Corrections.read(content["flat_field"], content.get("hot_pixels"), psf_done=psf_done)
    calibration = options.load(corrections)
    if content["white_balance"] == "flat":
        raise ParameterError("`white_balance` 'flat' needs flat frames: `--flat`. Use 'grey-world', or gains.")
    check_white_balance(content["white_balance"], calibration.light)
    own_resolution = load_at_psf_resolution(options, corrections)
    report = inspect_psf(own_resolution, own_resolution.frames.read(options.psf_file))
    content = {**content, "psf": options.psf_file, "dark": dark}
    return CameraContent(content, {}, [], []), (headline(report), calibration)


def _average(bench: BenchFrames, content: dict[str, Any], out: Path) -> CameraContent:
    """A camera file with pictures that are made of the frames."""
    photographs = bench.photographs
    known = Corrections.read(content["flat_field"], content.get("hot_pixels"))
    refuse_overwrite(out, *expanded((*bench.pictures, *photographs.dark_files, *photographs.flat)))
    done = calibrate_frames(photographs.of(bench.pictures), bench.frames, known)
    balance = _flat_balance(done.flat_colour) if content["white_balance"] == "flat" else content["white_balance"]
    without = dict.fromkeys((*PSF_OWN_FORMAT, *_PSF_KEYS))
    return replace(done, content={**content, "white_balance": balance, **without, **done.content})


def _flat_balance(colour: tuple[float, ...]) -> tuple[float, float, float]:
    """Gains that make the light of the flat frames white."""
    if len(colour) != 3 or min(colour) <= 0:
        raise ParameterError(
            "`white_balance` 'flat' needs flat frames in colour: `--flat`. Use 'grey-world', or gains."
        )
    red, green, blue = colour
    return round(green / red, 4), 1.0, round(green / blue, 4)


def _write(out: Path, new: CameraContent, inspected: _Inspected | None, pairs: Path | None) -> None:
    """Write the camera file, refined if there are pairs, and print how to use it.

    The file appears when it is complete and checked: a PSF that is averaged is inspected as it was written.
    """
    with draft_of(out) as draft:
        psf_file = write_camera_with_parts(draft, new.content, new.parts)["psf"]
        verdict, calibration = inspected or _inspected(draft, psf_file)
        note(*new.notes)
        say(*new.results)
        if pairs is not None:
            refine(draft, pairs, out.with_name(f"{out.stem}-refinement.json"))
            calibration = Calibration.load(draft)
    height, width = calibration.size
    say(
        verdict,
        f"PSF {calibration.psf_hash}, {height} x {width} pixels. More about it: mwdn inspect --camera {quoted(out)}",
        f"Use it: mwdn reconstruct CAPTURES --camera {quoted(out)}",
    )


def _inspected(camera: Path, psf_file: Path) -> _Inspected:
    calibration = Calibration.load(camera)
    check_white_balance(calibration.white_balance, calibration.light)
    return headline(inspect_psf(calibration, calibration.frames.read(psf_file))), calibration


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
