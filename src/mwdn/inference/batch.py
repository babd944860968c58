"""Reconstruct a folder of captures: read, reconstruct, check and write in parallel, in one process or several."""

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor, nn

from mwdn.calibration.frame_operations import enlarge_binned
from mwdn.data.captures import read_capture
from mwdn.diagnosis import Verdict
from mwdn.diagnosis.captures import examine_capture, refuse_dark
from mwdn.diagnosis.exif import exif_turn, settle_exif
from mwdn.diagnosis.psf_encoding import PsfGammaTest
from mwdn.diagnosis.sizes import mismatch
from mwdn.diagnosis.trust import Trust, examine_picture
from mwdn.errors import ImageError, MwdnError, ShapeError
from mwdn.inference.origin import origin, settings_hash
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
from mwdn.io.exif import orientation
from mwdn.io.files import as_image_error, is_full, write_json
from mwdn.io.formats import is_for_viewing
from mwdn.io.images import read_frame, read_picture, write_picture
from mwdn.io.support_picture import support_picture
from mwdn.runtime import distributed
from mwdn.runtime.iterations import watch_iterations
from mwdn.runtime.streams import prefetch
from mwdn.runtime.transfers import to_device, to_host
from mwdn.solvers import Pose, align
from mwdn.types import Measurement, Scene, Size

SHOWN = 12
"""Number of captures on the summary: the first ones."""


@dataclass(frozen=True)
class Job:
    """One capture and its picture.

    Args:
        capture: file of the capture.
        output: file of the picture.
        number: of the capture, from 0.
        origin: hash of everything the picture depends on, see `mwdn.inference.origin`.
        measurement: (1, C, H, W); like ``pose`` and ``scene`` dropped when the job is done.
        pose: of the PSF, if the consistency is checked.
        scene: (1, C, H, W).
        room_light: part of the capture's light that was subtracted as the room's; `None` if it was not looked for.
        existing: whether the picture was already there and nothing was done.
        full_size: height and width of the picture, if it is to be larger than the measurement.
        verdicts: on the capture, the PSF and the picture, if they are checked.
        trust: in the PSF and the picture, if they are checked.
        error: why there is no picture.
    """

    capture: Path
    output: Path
    number: int = 0
    origin: str = ""
    measurement: Measurement | None = None
    pose: Pose | None = None
    scene: Scene | None = None
    room_light: float | None = None
    existing: bool = False
    full_size: Size | None = None
    verdicts: tuple[Verdict, ...] = ()
    trust: Trust | None = None
    error: MwdnError | None = None


def _step(work: Callable[["Batch", Job], Job]) -> Callable[["Batch", Job], Job]:
    """Make a step of a batch: an error ends this capture's job, not the batch, unless the disk is full."""

    def step(batch: "Batch", job: Job) -> Job:
        try:
            return work(batch, job)
        except MwdnError as error:
            if is_full(error.__cause__):
                raise
            return replace(job, measurement=None, pose=None, scene=None, error=error)

    return step


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
    _mismatches: dict[tuple[int, ...], ShapeError] = field(default_factory=dict, init=False, repr=False)

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
        solves = not isinstance(self.reconstruct.method, nn.Module)  # a network iterates only at its start

        def reconstruct(job: Job) -> Job:
            with watch_iterations(lambda part: progress(job.number + part * solves)):
                job = self._reconstruct(job)
            progress(job.number + 1.0)
            return job

        def finish(job: Job) -> Job:
            job = self._finish(job)
            report(job)
            return job

        numbers = distributed.work_queue(len(captures))
        jobs = (Job(Path(captures[n]), self.out / output_name(captures[n], self.format), n) for n in numbers)
        # Alignment and the check take longer than most methods: on a CPU the three steps share its cores.
        with prefetch(self._read, jobs) as read, prefetch(finish, map(reconstruct, read)) as finished:
            yield from finished

    @_step
    def _read(self, job: Job) -> Job:
        job = replace(job, origin=origin(self._settings_hash, job.capture))
        if self.resume and self._exists(job):
            return replace(job, existing=True)
        calibration = self.reconstruct.calibration
        frame = calibration.frames.read(job.capture)
        measurement = calibration.to_measurement(frame)
        self._check_fit(measurement)
        refuse_dark(measurement)
        measurement = to_device(measurement, self.reconstruct.device)
        full_size = calibration.frames.full_size(frame) if self.full_size else None
        measurement, share = self.reconstruct.without_room_light(measurement)
        job = replace(
            job, measurement=measurement, full_size=full_size, room_light=None if share is None else float(share)
        )
        if not self.check_consistency:
            return job
        verdicts = examine_capture(frame, calibration, for_viewing=is_for_viewing(job.capture))
        verdicts += self._psf_gamma(frame, verdicts)
        if self.psf_file is not None and calibration.psf_format.psf_orientation is None:
            verdicts += (exif_turn(orientation(job.capture), orientation(self.psf_file)),)
        return replace(job, pose=align(measurement, self.reconstruct.psf), verdicts=verdicts)

    @cached_property
    def _psf_gamma(self) -> PsfGammaTest:
        for_viewing = self.psf_file is not None and is_for_viewing(self.psf_file)
        return PsfGammaTest(self.reconstruct.calibration, for_viewing)

    def _check_fit(self, measurement: Measurement) -> None:
        """Check the size; the first capture of each wrong size is compared with the PSF at other bins."""
        try:
            self.reconstruct.calibration.check_fit(measurement)
        except ShapeError as error:
            size = tuple(measurement.shape[-2:])
            if size not in self._mismatches:
                self._mismatches[size] = mismatch(error, measurement, self.reconstruct.calibration)
            raise self._mismatches[size] from None

    @_step
    def _reconstruct(self, job: Job) -> Job:
        if job.measurement is None:
            return job
        return replace(job, scene=self.reconstruct.without_search(job.pose).on_device(job.measurement))

    @_step
    def _finish(self, job: Job) -> Job:
        if job.measurement is None or job.scene is None:
            return job
        trust = self._examine(job.measurement, job.scene, job.pose)
        verdicts = settle_exif((*job.verdicts, *trust.verdicts)) if trust else ()
        calibration, pitch = self.reconstruct.calibration, self.reconstruct.calibration.pitch_um
        content: dict[str, object] = {"method": self.method, "psf_hash": calibration.psf_hash, "origin": job.origin}
        content |= {"file": job.output.name, "bin": calibration.frames.bin}
        content |= {} if job.room_light is None else {"room_light": round(job.room_light, 4)}
        if trust:
            content |= {**trust.content, "verdicts": [asdict(verdict) for verdict in verdicts]}
        scene, sidecar = to_host(self.reconstruct.finish(job.scene)), job.output.with_suffix(".json")
        if job.full_size:
            scene = enlarge_binned(scene, calibration.frames.bin, job.full_size)
            pitch = pitch and pitch / calibration.frames.bin
        before = read_sidecar(sidecar)
        with as_image_error(sidecar):  # the new picture must not have an old sidecar or map
            sidecar.unlink(missing_ok=True)
            support_name(job.output).unlink(missing_ok=True)
        write_output(job.output, scene, self.format, pitch)
        try:
            if trust and self.map:
                write_picture(support_name(job.output), support_picture(scene, trust.support.map))
            write_json(sidecar, content)
        except ImageError:  # the disk is full: the next run would take the picture for something else
            job.output.unlink()
            support_name(job.output).unlink(missing_ok=True)
            raise
        remove_other_format(job.output, job.capture, before=before, now=content)
        return replace(job, measurement=None, pose=None, scene=None, trust=trust, verdicts=verdicts)

    def _examine(self, measurement: Measurement, scene: Scene, pose: Pose | None) -> Trust | None:
        """Check a scene if requested; an `ImageError` unless the scene and the result are finite."""
        trust, finite = None, bool(scene.isfinite().all())
        if finite and self.check_consistency:
            given = self.reconstruct.calibration.psf_format.psf_orientation
            trust = examine_picture(measurement, self.reconstruct.psf, scene, pose=pose, given=given)
            finite = trust.finite
        if not finite:
            raise ImageError(
                "The reconstruction holds NaN, infinity or too large numbers: nothing is written. The capture's "
                f"brightest pixel is {measurement.amax():.3g}, where 1 is saturation. Scale it, or use another method."
            )
        return trust

    @cached_property
    def _settings_hash(self) -> str:
        return settings_hash(self.reconstruct, self.format, full_size=self.full_size)

    def _exists(self, job: Job) -> bool:
        """Whether a job's picture is complete, of the same origin, and checked if that is requested."""
        content = read_sidecar(job.output.with_suffix(".json"))
        checked = "doubtful" in content or not self.check_consistency
        checked &= not self.map or support_name(job.output).is_file()
        return checked and content.get("origin") == job.origin != "" and job.output.is_file()

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
