"""`mwdn reconstruct`: captures to pictures, in one process or several."""

import os
from collections import ChainMap
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple

from cyclopts import Parameter
from rich.markup import escape

from mwdn.calibration.white_balance import WhiteBalance
from mwdn.cli.automatic_bin import binned
from mwdn.cli.camera import CameraOptions
from mwdn.cli.doubts import Doubts
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.method_options import MethodOptions, read_options
from mwdn.cli.progress import show_progress
from mwdn.cli.terminal import Json, complain, counted, detail, if_interrupted, note, print_json, say, warn
from mwdn.data.captures import list_captures
from mwdn.diagnosis.trust import check_size
from mwdn.errors import ParameterError, one_line
from mwdn.inference.batch import Batch, Job
from mwdn.inference.outputs import Format, check_outputs, output_name, read_sidecar
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.exif import orientation
from mwdn.io.files import check_folder
from mwdn.io.listing import enumerate_names
from mwdn.runtime import distributed


@no_empty_folder
def reconstruct(  # noqa: PLR0913
    *captures: Path,
    camera: CameraOptions = CameraOptions(),
    method: str = "universal",
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/reconstruct"),
    format: Format = "png",
    full_size: bool = False,
    align: bool | None = None,
    ensemble: Annotated[bool, Parameter(negative=())] = False,
    room_light: bool | None = None,
    white_balance: WhiteBalance | None = None,
    trust: bool = True,
    map: Annotated[bool, Parameter(negative=())] = False,
    resume: bool | None = None,
    device: str | None = None,
    json: Json = False,
    auto_bin: Annotated[bool, Parameter(show=False)] = True,
    **options: MethodOptions,
) -> int:
    """Reconstruct captures: files, or folders of them.

    Options of a solver: --regularisation 1e-4, --iterations 50 ...; `mwdn methods admm` lists those of admm.

    Several processes, or machines with a common file system: torchrun --nproc-per-node 4 -m mwdn reconstruct ...

    Args:
        captures: raw frames of the camera.
        camera: its calibration.
        method: universal (a network for any camera), universal-small (a faster one), admm, pyramid, wiener, fista,
            the path of a checkpoint, or hub:owner/name.
        out: folder for the pictures. Beside each, a .json says how well it explains its capture; summary.png shows
            the first twelve pictures and their captures.
        format: png and png16 are sRGB for viewing; tiff, imagej (for ImageJ, with its scale) and npy hold the linear
            float32 values.
        full_size: interpolate the pictures of binned captures to the captures' size before binning. Without --bin,
            PSF and captures are binned as far as that loses little; --bin 1 refuses.
        align: estimate the pose of the PSF from each capture (rotation, scale, displaced aperture, haze), for a camera
            that has changed since its calibration; the default for networks that were trained with alignment
            (universal).
        ensemble: average a network's pictures of the capture and its three mirror images: four times the time;
            universal-small gains 0.1 to 0.4 dB, universal nothing.
        room_light: find even light, a slope or a spot of light of the room in each capture and subtract it; on by
            default for networks that align the PSF (universal), unless --ambient is given. The .json and a line say its
            share.
        white_balance: of the pictures: grey-world, psf (the point source is white), or gains of red, green and blue.
        trust: check how well each picture explains its capture; takes a second or two for a small one.
        map: also draw which parts of each picture its capture supports, as NAME.support.png; not with --no-trust.
        resume: skip each capture whose picture is there, made from the same file in the same way; the default for
            several processes.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        json: print a list with the content of each picture's .json to standard output, all else to standard error.
        auto_bin: whether --bin is not given.
        **options: options of the method.
    """
    if map and not trust:
        raise ParameterError("`map` needs the check that `--no-trust` skips. Leave out one of them.")
    method_options = read_options([method], options, reconstruct)[method]
    with distributed.process_group():
        calibration, sentence = camera.read()
        remarks = [sentence]
        check_size(calibration.psf)
        # Listed by the first process: files may be added to a folder meanwhile.
        files: list[str] = distributed.broadcast_json(lambda: _list_files(captures, camera, out, format))
        coarse = binned(calibration, camera, method, files) if auto_bin else None
        if coarse is not None:
            calibration, remarks = coarse
        reconstructor = Reconstructor(
            method,
            replace(calibration, white_balance=None),  # the camera file's is `white_balance` unless `none`
            align=align,
            device=distributed.local_device(device),
            white_balance=white_balance,
            ensemble=ensemble,
            room_light=room_light,
            **method_options,
        )
        batch = Batch(
            reconstructor,
            method,
            out,
            format,
            check_consistency=trust,
            map=map,
            resume=distributed.world_size() > 1 if resume is None else resume,
            psf_file=camera.psf_file,
            full_size=full_size,
        )
        is_first = distributed.rank() == 0
        if is_first:
            _announce(batch, camera.psf_file, remarks)
        outcome = _run(batch, files)
        if is_first:
            _summarise(batch, files, outcome, json=json)
    status = 1 if outcome.failed else 0
    distributed.set_exit_status(status)
    return status


def _list_files(captures: Iterable[Path], camera: CameraOptions, out: Path, format: Format) -> list[str]:
    """List the captures and check that their pictures can be written to ``out``."""
    files, skipped = list_captures(captures, exclude=camera.roles)
    note(*skipped)
    check_outputs(files, out, format, protected=camera.files)
    if os.path.realpath(out) in map(os.path.realpath, captures):  # which takes a link to itself, too
        raise ParameterError(
            f"`{out}` holds the captures: the next run would take the pictures for captures. Choose another folder: "
            "`--out`."
        )
    check_folder(out)
    return files


def _announce(batch: Batch, psf_file: Path, remarks: list[str]) -> None:
    """Print method, device and PSF, with the warning and the remarks about them."""
    reconstructor = batch.reconstruct
    warn(reconstructor.warning)
    detail(f"{batch.method} on {reconstructor.device}")
    note(*filter(None, remarks))
    background = ", ".join(f"{level:.4f}" for level in reconstructor.calibration.background)
    say(f"PSF {reconstructor.calibration.psf_hash}, background {background} of the full scale subtracted")
    _name_turned([psf_file.name] if orientation(psf_file) != 1 else [])


def _name_turned(turned: list[str]) -> None:
    """Name files with an EXIF orientation: a phone shows them turned, unlike the pictures."""
    if turned:
        note(
            f"Shown turned elsewhere, by EXIF orientation: {enumerate_names(turned)}. Frames are not turned: pictures "
            "are in the orientation of the sensor."
        )


class _Outcome(NamedTuple):
    """Errors by capture, number of pictures that existed before, names of captures with an EXIF orientation."""

    failed: Mapping[str, str]
    existing: int
    turned: list[str]


def _run(batch: Batch, files: list[str]) -> _Outcome:
    """Reconstruct all captures; returns the outcome over all processes."""
    failed: dict[str, str] = {}
    turned: list[str] = []
    done = existing = 0
    doubts = Doubts()

    def go_on() -> str:
        verb = "is" if done == 1 else "are"
        of = counted(len(files), "capture")
        return f"Interrupted: {done:,} of {of} {verb} done. The same command with --resume goes on."

    def show(job: Job) -> None:
        nonlocal done, existing
        if job.error:
            failed[files[job.number]] = str(job.error)
        elif not job.existing and orientation(job.capture) != 1:
            turned.append(job.capture.name)
        done += job.error is None
        existing += job.existing
        _report(job)
        doubts.add(one_line(job.capture.name), job.verdicts)

    def show_part(reconstructed: float) -> None:
        checking = batch.check_consistency and reconstructed == len(files)
        progress.update(reconstructed, "checking" if checking else "", len(files) if reconstructed else None)

    with if_interrupted(go_on), show_progress(enabled=distributed.rank() == 0) as progress:
        progress.start("Reconstructing", len(files) if len(files) > 1 else None)
        with closing(batch.run(files, show, progress=show_part)) as jobs:
            for _ in jobs:
                pass
        progress.update(len(files))
    doubts.summarise()
    shares = distributed.gather_json((failed, existing, turned))
    errors, counts, names = zip(*shares, strict=True)
    return _Outcome(ChainMap(*errors), sum(counts), [*chain.from_iterable(names)])


def _report(job: Job) -> None:
    """Print the outcome of a job."""
    if job.error:
        named = one_line(f"`{job.capture}`") in str(job.error)
        complain("[red]Error:[/]" if named else f"[red]{escape(one_line(str(job.capture)))}:[/]", job.error)
    elif job.trust:
        lit = f"; {job.room_light:.0%} of its light was the room's" if job.room_light else ""
        say(f"{one_line(job.capture.name)}: {job.trust.sentence}{lit}")


def _summarise(batch: Batch, files: list[str], outcome: _Outcome, *, json: bool) -> None:
    """Write the contact sheet; print the entries of --json and how many pictures there are."""
    _name_turned(outcome.turned)
    batch.summarise(files)
    if json:
        print_json([_entry(batch, file, outcome.failed.get(file)) for file in files])
    before = f", {outcome.existing} of them before" if outcome.existing else ""
    done = f"{len(files) - len(outcome.failed):,} of " if outcome.failed else ""
    say(f"{done}{counted(len(files), 'capture')} reconstructed into {batch.out}{before}")


def _entry(batch: Batch, capture: str, error: str | None) -> dict[str, object]:
    """Entry of --json for one capture."""
    if error is not None:
        return {"capture": capture, "picture": None, "error": error}
    picture = batch.out / output_name(capture, batch.format)
    return {"capture": capture, "picture": str(picture), **read_sidecar(picture.with_suffix(".json"))}
