"""`mwdn reconstruct`: captures to pictures, by one process or by many."""

import os
from collections import Counter
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import torch
from rich.markup import escape
from rich.progress import Progress

from mwdn.calibration import Calibration
from mwdn.cli.camera import CameraOptions, complain, console, errors, warn
from mwdn.data.captures import list_captures
from mwdn.errors import ParameterError, PsfError
from mwdn.inference.batch import Batch, Format, Job, check_outputs
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import check_folder
from mwdn.runtime import distributed

SMALLEST = 15
"""Pixels along each side of a PSF. A right one of 12 is trusted on 1 or 2 captures in 10, of 15 on 7 or 8."""


def reconstruct(  # noqa: PLR0913
    *captures: Path,
    camera: CameraOptions,
    method: str = "universal",
    regularisation: float | None = None,
    out: Path = Path("results/reconstruct"),
    format: Format = "png",
    trust: bool = True,
    resume: bool | None = None,
    device: str | None = None,
) -> int:
    """Reconstruct captures: files, or folders of them.

    Several processes or machines with one file system: torchrun --nproc-per-node 4 -m mwdn reconstruct ...

    Args:
        captures: raw frames of the camera.
        camera: its calibration.
        method: universal (a network for any camera), universal-small (a faster one), admm, pyramid, wiener, fista,
            the path of a checkpoint, or hub:owner/name.
        regularisation: tau of admm or lambda of wiener; less keeps more detail and more noise.
        out: folder for the pictures, beside each a .json that says how far to trust it; summary.png shows the first
            twelve beside their measurements.
        format: png and png16 are sRGB for people, tiff and npy hold the linear float32 values.
        trust: find how far to trust each picture, which takes a second or two of a small one.
        resume: leave out each capture whose picture is there, made of the same file in the same way; so do several
            processes unless --no-resume is given.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
    """
    with distributed.process_group():
        first, apart = distributed.rank() == 0, (camera.psf, camera.dark)
        calibration = _load(camera)

        def found() -> bytes:
            files = list_captures(captures, exclude=apart)
            check_outputs(files, out, format, protected=apart)
            _check_out(out, captures, files)
            return "\0".join(files).encode(errors="surrogateescape")

        # Listed once: a folder may still grow.
        files = distributed.broadcast(found).decode(errors="surrogateescape").split("\0")
        device_here = distributed.local_device(device)
        reconstructor = Reconstructor(method, calibration, regularisation=regularisation, device=device_here)
        if first:
            warn(reconstructor.warning)
            levels = ", ".join(f"{level:.4f}" for level in calibration.background)
            told = f"PSF {calibration.psf_hash}, background {levels} of the full scale subtracted"
            console.print(told, soft_wrap=True)
        again = distributed.world_size() > 1 if resume is None else resume
        batch = Batch(reconstructor, method, out, format, judge=trust, resume=again)
        ended: Counter[str] = Counter()
        with (
            closing(batch.run(files)) as jobs,
            Progress(console=console, disable=len(files) == 1 or not first) as bars,
        ):
            bar = bars.add_task("Reconstructing", total=len(files))
            for job in jobs:
                bars.update(bar, completed=job.number + 1)  # the others' too
                ended[_told(job)] += 1
        counts = torch.tensor([ended["failed"], ended["kept"]])
        failed, kept = distributed.all_reduce_sum(counts).tolist()
        if first:
            batch.summarise(files)
            there = f", {kept} of them before" if kept else ""
            done = f"{len(files) - failed} of {len(files)} captures reconstructed into {out}{there}"
            console.print(done, highlight=False, markup=False, soft_wrap=True)
    status = 1 if failed else 0
    distributed.set_exit_status(status)
    return status


def _load(camera: CameraOptions) -> Calibration:
    """The calibration; a `PsfError` where it is too small for any answer to mean something."""
    calibration = camera.load()
    height, width = calibration.size
    if min(height, width) < SMALLEST:
        raise PsfError(
            f"The PSF ({height} x {width}) must have at least {SMALLEST} pixels along each side. Take the whole frame "
            "of the sensor, or crop and bin it less: `--crop`, `--bin`, `--psf-bin`."
        )
    return calibration


def _check_out(out: Path, captures: Iterable[Path], files: list[str]) -> None:
    """See that the pictures have a folder of their own that can be written to; none is made if no capture is there."""
    if out.resolve() in [path.resolve() for path in captures]:
        raise ParameterError(
            f"`{out}` holds the captures: the pictures would be taken for captures the next time. Choose another "
            "folder: `--out`."
        )
    if any(map(os.path.exists, files)):
        check_folder(out)


def _told(job: Job) -> str:
    """Print what became of a capture; returns it in a word."""
    if job.error:
        complain(f"[red]{escape(str(job.capture))}:[/]", job.error)
        return "failed"
    if job.overexposed:
        warn(
            f"{job.capture.name} is overexposed: {job.saturated:.1%} of its pixels are saturated, and no PSF explains "
            "them. Lower the exposure."
        )
    if job.trust:
        told = f"{job.capture.name} {job.trust.sentence}"
        (errors if job.trust.doubtful else console).print(told, highlight=False, markup=False, soft_wrap=True)
    return "kept" if job.kept else "done"
