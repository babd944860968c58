"""Reconstruct a folder of captures: read, reconstruct, check and write in parallel, in one process or several."""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from mwdn.calibration.frame_operations import enlarge_binned
from mwdn.data.captures import read_capture
from mwdn.diagnosis import Verdict
from mwdn.diagnosis.trust import Trust
from mwdn.errors import ImageError, MwdnError, ShapeError, without_traceback
from mwdn.inference.capture_pipeline import CapturePipeline, PreparedCapture, PsfFile, refuse_infinite
from mwdn.inference.origin import origin as origin_hash
from mwdn.inference.origin import settings_hash
from mwdn.inference.outputs import (
    SUMMARY,
    Format,
    output_name,
    read_sidecar,
    remove_other_format,
    support_name,
    write_output,
)
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import contact_sheet, thumbnail
from mwdn.io.files import as_image_error, is_full, write_json
from mwdn.io.images import read_frame, read_picture, write_picture
from mwdn.io.support_picture import support_picture
from mwdn.runtime import distributed
from mwdn.runtime.iterations import watch_iterations
from mwdn.runtime.streams import prefetch
from mwdn.runtime.transfers import to_host
from mwdn.types import Measurement, Scene, Size, size_of

SHOWN = 12
"""Number of captures on the summary: the first ones."""


@dataclass(frozen=True)
class Job:
    """One capture and what became of it.

    Args:
        capture: file of the capture.
        output: file of the picture.
        number: of the capture, from 0.
        existing: whether the picture was already there and nothing was done.
        room_light: part of the capture's light that was subtracted as the room's; `None` if it was not looked for.
        verdicts: on the capture, the PSF and the picture, if they are checked.
        trust: in the PSF and the picture, if they are checked.
        error: why there is no picture.
    """

    capture: Path
    output: Path
    number: int = 0
    existing: bool = False
    room_light: float | None = None
    verdicts: tuple[Verdict, ...] = ()
    trust: Trust | None = None
    error: MwdnError | None = None


class _Read(NamedTuple):
    """A capture that was read."""

    job: Job
    origin: str
    """Hash of everything the picture depends on, see `mwdn.inference.origin`."""
    prepared: PreparedCapture
    full_size: Size | None
    """Height and width of the picture, if it is to be larger than the measurement."""


class _Solved(NamedTuple):
    """A capture that was reconstructed."""

    read: _Read
    scene: Scene


_Result = TypeVar("_Result")


def _attempt(job: Job, step: Callable[[], _Result]) -> _Result | Job:
    """Do a step of a job: an error ends this job, not the batch, unless the disk is full."""
    try:
        return step()
    except MwdnError as error:
        if is_full(error.__cause__):
            raise
        return replace(job, error=without_traceback(error))


@dataclass(frozen=True)
class Batch:
    """Reconstruction of one camera's captures by one method, into one folder.

    Each picture has a sidecar file, a ``.json`` of the same name, with the consistency check and the hash of
    everything the picture depends on. It is written after the picture, so a picture with a sidecar is complete.

    Args:
        reconstruct: the method and the camera.
        method: name of the method, for the sidecars and the summary.
        out: folder of the pictures.
        format: of the pictures.
        check_consistency: check each picture against its capture, which may take longer than the reconstruction.
        map: also draw which parts of each picture its capture supports, into `support_name`; needs
            ``check_consistency``.
        resume: skip each capture whose picture exists with the same hash (`mwdn.inference.origin`), and with a
            consistency check and a map if they are requested.
        psf_file: file of the PSF: its EXIF orientation is compared with the captures', its type tells about its gamma.
        full_size: interpolate the pictures of binned captures to the captures' size before binning.
    """

    reconstruct: Reconstructor
    method: str
    out: Path
    format: Format = "png"
    check_consistency: bool = True
    map: bool = False
    resume: bool = False
    psf_file: Path | None = None
    full_size: bool = False
    _refused: dict[Size, str] = field(default_factory=dict, init=False, repr=False)

    def run(
        self,
        captures: Sequence[str | Path],
        report: Callable[[Job], None] = lambda job: None,
        *,
        progress: Callable[[float], None] = lambda done: None,
    ) -> Generator[Job, None, None]:
        """Reconstruct captures in their order; with several processes, each capture in one of them.

        Args:
            captures: files.
            report: called with each job when its picture is written, in another thread. The generator yields the job
                later: when the next capture, or the one after it, is reconstructed.
            progress: called with the number of captures that are reconstructed, and after each iteration of a solver
                with the part of the current one.
        """
        solves = not isinstance(self.reconstruct.method, nn.Module)  # a network's iterations are only its first part

        def read(job: Job) -> _Read | Job:
            return _attempt(job, lambda: self._read(job))

        def reconstruct(work: _Read | Job) -> _Solved | Job:
            number = work.number if isinstance(work, Job) else work.job.number
            with watch_iterations(lambda part: progress(number + part * solves)):
                solved = work if isinstance(work, Job) else _attempt(work.job, lambda: self._solve(work))
            progress(number + 1.0)
            return solved

        def finish(work: _Solved | Job) -> Job:
            job = work if isinstance(work, Job) else _attempt(work.read.job, lambda: self._write(work))
            report(job)
            return job

        numbers = distributed.work_queue(len(captures))
        jobs = (Job(Path(captures[n]), self.out / output_name(captures[n], self.format), n) for n in numbers)
        # Alignment and the check take longer than most methods: on a CPU the three steps share its cores.
        with prefetch(read, jobs) as prepared, prefetch(finish, map(reconstruct, prepared)) as finished:
            yield from finished

    def _read(self, job: Job) -> _Read | Job:
        origin = origin_hash(self._settings_hash, job.capture)
        if self.resume and self._exists(job, origin):
            return replace(job, existing=True)
        calibration = self.reconstruct.calibration
        frame = calibration.frames.read(job.capture)
        measurement = calibration.to_measurement(frame)
        self._check(measurement)
        prepared = self._pipeline.prepare(measurement, pose=self.check_consistency)
        if self.check_consistency:
            job = replace(job, verdicts=self._pipeline.examine_frame(frame, job.capture))
        full_size = calibration.frames.full_size(frame) if self.full_size else None
        return _Read(replace(job, room_light=prepared.room_light), origin, prepared, full_size)

    def _check(self, measurement: Measurement) -> None:
        """`CapturePipeline.check`; captures of a size that was refused before are refused for the same reason."""
        size = size_of(measurement)
        if size in self._refused:
            raise ShapeError(self._refused[size])
        try:
            self._pipeline.check(measurement)
        except ShapeError as error:
            self._refused[size] = str(error)
            raise

    def _solve(self, read: _Read) -> _Solved:
        return _Solved(read, self._pipeline.solve(read.prepared))

    def _write(self, solved: _Solved) -> Job:
        (job, origin, prepared, _), scene = solved
        refuse_infinite(prepared, scene)
        calibration = self.reconstruct.calibration
        content: dict[str, object] = {"method": self.method, "psf_hash": calibration.psf_hash, "origin": origin}
        content |= {"file": job.output.name, "bin": calibration.frames.bin}
        if job.room_light is not None:
            content["room_light"] = round(job.room_light, 4)
        if self.check_consistency:
            trust, verdicts = self._pipeline.examine_scene(prepared, scene, job.verdicts)
            content |= {**trust.content, "verdicts": [asdict(verdict) for verdict in verdicts]}
            job = replace(job, trust=trust, verdicts=verdicts)
        self._write_files(job, self._picture(solved), content)
        return job

    def _picture(self, solved: _Solved) -> Scene:
        """The picture, on the CPU, in the size that was requested."""
        picture, size = to_host(self.reconstruct.finish(solved.scene)), solved.read.full_size
        if size is None:
            return picture
        frames = self.reconstruct.calibration.frames
        axes = [-2] if frames.upside_down else []  # captures are binned before they are turned
        return enlarge_binned(picture.flip(axes), frames.bin, size).flip(axes)

    def _write_files(self, job: Job, picture: Scene, content: dict[str, object]) -> None:
        """Write the picture, the map and the sidecar, which is last: a picture with a sidecar is complete."""
        calibration = self.reconstruct.calibration
        pitch = calibration.pitch_um
        if pitch is not None and self.full_size:
            pitch = pitch / calibration.frames.bin
        sidecar, map_file = job.output.with_suffix(".json"), support_name(job.output)
        before = read_sidecar(sidecar)
        with as_image_error(sidecar):  # the new picture must not have an old sidecar or map
            sidecar.unlink(missing_ok=True)
            map_file.unlink(missing_ok=True)
        write_output(job.output, picture, self.format, pitch)
        try:
            if job.trust and self.map:
                write_picture(map_file, support_picture(picture, job.trust.support.map))
            write_json(sidecar, content)
        except ImageError:  # a full disk; without a sidecar, the next run would refuse to replace the picture
            job.output.unlink()
            map_file.unlink(missing_ok=True)
            raise
        remove_other_format(job.output, job.capture, before=before, now=content)

    @cached_property
    def _pipeline(self) -> CapturePipeline:
        return CapturePipeline(self.reconstruct, PsfFile() if self.psf_file is None else PsfFile.read(self.psf_file))

    @cached_property
    def _settings_hash(self) -> str:
        return settings_hash(self.reconstruct, self.format, full_size=self.full_size)

    def _exists(self, job: Job, origin: str) -> bool:
        """Whether a job's picture is complete, of this origin, and checked if that is requested."""
        content = read_sidecar(job.output.with_suffix(".json"))
        same_origin = origin != "" and content.get("origin") == origin
        checked = not self.check_consistency or "doubtful" in content
        mapped = not self.map or support_name(job.output).is_file()
        return same_origin and checked and mapped and job.output.is_file()

    def summarise(self, captures: Iterable[str | Path]) -> None:
        """Write a contact sheet of the first captures and their pictures on the disk, unless there are none.

        Raises:
            ImageError: the contact sheet cannot be written.
        """
        rows: list[list[Tensor]] = []
        for capture in captures:
            output = self.out / output_name(capture, self.format)
            if len(rows) == SHOWN:
                break
            if output.is_file():
                with suppress(MwdnError):
                    pair = read_capture(Path(capture), self.reconstruct.calibration), _read_output(output)
                    rows.append([thumbnail(picture) for picture in pair])
        if rows:
            titles = ["measurement", f"reconstruction ({Path(self.method).name})"]
            write_picture(self.out / SUMMARY, contact_sheet(rows, titles))


def _read_output(path: Path) -> Tensor:
    if path.suffix == ".png":
        return read_picture(path)
    return torch.from_numpy(read_frame(path)).movedim(-1, 0)[None]
