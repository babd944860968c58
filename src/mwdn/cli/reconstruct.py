"""`mwdn reconstruct`: captures to pictures, in one process or several."""

import os
from collections import Counter
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Annotated

import torch
from cyclopts import Parameter
from rich.markup import escape
from rich.progress import Progress

from mwdn.calibration import Calibration
from mwdn.cli.camera import CameraOptions, complain, console, errors, warn
from mwdn.cli.method_options import MethodOptions, read_options
from mwdn.data.captures import list_captures
from mwdn.errors import ParameterError, PsfError
from mwdn.inference.batch import Batch, Format, Job, check_outputs
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import check_folder
from mwdn.runtime import distributed

SMALLEST = 15
"""Minimum height and width of a PSF in pixels. The check accepts the right PSF of 12 pixels for 1 or 2 captures in 10,
of 15 pixels for 7 or 8."""


def reconstruct(  # noqa: PLR0913
    *captures: Path,
    camera: CameraOptions,
    method: str = "universal",
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/reconstruct"),
    format: Format = "png",
    align: bool | None = None,
    trust: bool = True,
    resume: bool | None = None,
    device: str | None = None,
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
        format: png and png16 are sRGB for viewing, tiff and npy hold the linear float32 values.
        align: estimate rotation, scale and haze of the PSF from each capture, for a camera that has changed since its
            calibration; by default for universal, and not for solvers.
        trust: check how well each picture explains its capture; takes a second or two for a small one.
        resume: skip each capture whose picture is there, made from the same file in the same way; the default for
            several processes.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        **options: options of the method.
    """
    method_options = read_options(method, options, reconstruct)
    with distributed.process_group():
        is_first, calibration = distributed.rank() == 0, _load(camera)
        # Listed by the first process: files may be added to a folder meanwhile.
        files: list[str] = distributed.broadcast_json(lambda: _list_files(captures, camera, out, format))
        local_device = distributed.local_device(device)
        reconstructor = Reconstructor(method, calibration, align=align, device=local_device, **method_options)
        if is_first:
            warn(reconstructor.warning)
            background = ", ".join(f"{level:.4f}" for level in calibration.background)
            console.print(
                f"PSF {calibration.psf_hash}, background {background} of the full scale subtracted", soft_wrap=True
            )
        resume = distributed.world_size() > 1 if resume is None else resume
        batch = Batch(reconstructor, method, out, format, check_consistency=trust, resume=resume)
        failed, existing = _run(batch, files)
        if is_first:
            batch.summarise(files)
            before = f", {existing} of them before" if existing else ""
            line = f"{len(files) - failed} of {len(files)} captures reconstructed into {out}{before}"
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    status = 1 if failed else 0
    distributed.set_exit_status(status)
    return status


def _load(camera: CameraOptions) -> Calibration:
    """Load the calibration; a `PsfError` if the PSF is too small for a reliable result."""
    calibration = camera.load()
    height, width = calibration.size
    if min(height, width) < SMALLEST:
        raise PsfError(
            f"The PSF ({height} x {width}) must have at least {SMALLEST} pixels along each side. Take the whole frame "
            "of the sensor, or crop and bin it less: `--crop`, `--bin`, `--psf-bin`."
        )
    return calibration


def _list_files(captures: Iterable[Path], camera: CameraOptions, out: Path, format: Format) -> list[str]:
    """List the captures and check that their pictures can be written to ``out``."""
    calibration_files = camera.psf, camera.dark
    files = list_captures(captures, exclude=calibration_files)
    check_outputs(files, out, format, protected=calibration_files)
    if out.resolve() in [path.resolve() for path in captures]:
        raise ParameterError(
            f"`{out}` holds the captures: the next run would take the pictures for captures. Choose another folder: "
            "`--out`."
        )
    if any(map(os.path.exists, files)):  # else no folder is made
        check_folder(out)
    return files


def _run(batch: Batch, files: list[str]) -> tuple[int, int]:
    """Reconstruct all captures; numbers of failed and of already existing ones, over all processes."""
    states: Counter[str] = Counter()
    show_progress = len(files) > 1 and distributed.rank() == 0
    with closing(batch.run(files)) as jobs, Progress(console=console, disable=not show_progress) as bars:
        bar = bars.add_task("Reconstructing", total=len(files))
        for job in jobs:
            bars.update(bar, completed=job.number + 1)  # counts the captures of other processes, too
            states[_report(job)] += 1
    failed, existing = distributed.all_reduce_sum(torch.tensor([states["failed"], states["existing"]])).tolist()
    return failed, existing


def _report(job: Job) -> str:
    """Print the outcome of a job; returns its state."""
    if job.error:
        complain(f"[red]{escape(str(job.capture))}:[/]", job.error)
        return "failed"
    if job.overexposed:
        warn(
            f"{job.capture.name} is overexposed: {job.saturated:.1%} of its pixels are saturated, and no PSF explains "
            "them. Lower the exposure."
        )
    if job.consistency:
        line = f"{job.capture.name} {job.consistency.sentence}"
        (errors if job.consistency.doubtful else console).print(line, highlight=False, markup=False, soft_wrap=True)
    return "existing" if job.existing else "done"
