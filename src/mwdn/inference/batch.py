"""Reconstruct a folder of captures: read, reconstruct, check and write in parallel, in one process or several."""

import json
import math
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from mwdn.calibration.psf import SATURATED_PART
from mwdn.data.captures import read_capture
from mwdn.errors import ImageError, MwdnError, ParameterError
from mwdn.evaluation.consistency import Consistency, consistency
from mwdn.inference.origin import origin, settings_hash
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import contact_sheet, thumbnail, to_display
from mwdn.io.files import as_image_error, path_resolver, write_json
from mwdn.io.images import read_frame, read_picture, write_linear, write_picture
from mwdn.runtime import distributed
from mwdn.runtime.streams import prefetch
from mwdn.runtime.transfers import to_device, to_host
from mwdn.solvers import Pose, align
from mwdn.types import Measurement, Scene

Format = Literal["png", "png16", "tiff", "npy"]
"""``png`` and ``png16`` are sRGB, for viewing; ``tiff`` and ``npy`` hold the linear float32 values."""

_SUFFIX = {"png": ".png", "png16": ".png", "tiff": ".tif", "npy": ".npy"}
SUMMARY = "summary.png"
SHOWN = 12
"""Number of captures on the summary: the first ones."""


def output_name(capture: str | Path, format: Format) -> str:
    """File name of a capture's picture: the capture's name with the format's suffix."""
    return Path(capture).stem + _SUFFIX[format]


def check_outputs(
    captures: Sequence[str | Path], out: Path, format: Format, *, protected: Iterable[Path | None] = ()
) -> None:
    """Check that every capture has its own file name in ``out`` and that nothing of the user's is overwritten.

    Raises:
        ParameterError: two captures have the same output, an output would overwrite an input or a ``.json`` that is
            not of this package, or ``out`` is a file.
    """
    if out.exists() and not out.is_dir():
        raise ParameterError(f"`{out}` must be a folder, but is a file. Choose another one: `--out`.")
    real = path_resolver()
    inputs = {real(str(path)) for path in (*captures, *protected) if path is not None}

    def check(output: str) -> None:
        if real(output) in inputs:
            raise ParameterError(f"`{output}` would overwrite an input. Choose another folder: `--out`.")

    existing = {path.name for path in out.glob("*.json")}
    check(str(out / SUMMARY))
    sources = {SUMMARY: "the summary picture"}
    start = str(out / "x").removesuffix("x")  # text instead of paths: there may be a million captures
    for capture in captures:
        name = output_name(capture, format)
        sidecar = name.removesuffix(_SUFFIX[format]) + ".json"
        check(start + name)
        check(start + sidecar)
        if sidecar in existing and not _read_sidecar(out / sidecar):
            raise ParameterError(
                f"`{start}{sidecar}` was not written by mwdn and would be lost. Choose another folder: `--out`."
            )
        if name in sources:
            raise ParameterError(
                f"`{capture}` and {sources[name]} would both be written to `{start}{name}`. Reconstruct them into "
                "two folders: `--out`."
            )
        sources[name] = f"`{capture}`"


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
        existing: whether the picture was already there and nothing was done.
        saturated: fraction of saturated pixels, see `Calibration.saturated_part`.
        consistency: of the picture with the capture, if it is checked.
        error: why there is no picture.
    """

    capture: Path
    output: Path
    number: int = 0
    origin: str = ""
    measurement: Measurement | None = None
    pose: Pose | None = None
    scene: Scene | None = None
    existing: bool = False
    saturated: float = 0.0
    consistency: Consistency | None = None
    error: MwdnError | None = None

    @property
    def overexposed(self) -> bool:
        """Whether so many pixels are saturated that even the right PSF may look wrong."""
        return self.saturated > SATURATED_PART


def _step(work: Callable[["Batch", Job], Job]) -> Callable[["Batch", Job], Job]:
    """Make a step of a batch: an error ends this capture's job, not the batch."""

    def step(batch: "Batch", job: Job) -> Job:
        try:
            return work(batch, job)
        except MwdnError as error:
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
        resume: skip each capture whose picture exists with the same hash (`mwdn.inference.origin`), and with a
            consistency check if one is requested.
    """

    reconstruct: Reconstructor
    method: str
    out: Path
    format: Format = "png"
    check_consistency: bool = True
    resume: bool = False

    def run(self, captures: Sequence[str | Path]) -> Generator[Job, None, None]:
        """Reconstruct captures in their order; with several processes, each capture in one of them."""
        numbers = distributed.work_queue(len(captures))
        jobs = (Job(Path(captures[n]), self.out / output_name(captures[n], self.format), n) for n in numbers)
        # Alignment and the check take longer than most methods: on a CPU the three steps share its cores.
        with prefetch(self._read, jobs) as read, prefetch(self._finish, map(self._reconstruct, read)) as finished:
            yield from finished

    @_step
    def _read(self, job: Job) -> Job:
        job = replace(job, origin=origin(self._settings_hash, job.capture))
        if self.resume and self._exists(job):
            return replace(job, existing=True)
        calibration = self.reconstruct.calibration
        frame = calibration.frames.read(job.capture)
        measurement = calibration.correct(frame)
        if measurement.amax() <= 0:
            raise ImageError("The sensor saw no light: no pixel is brighter than the dark frame, or black.")
        measurement = to_device(measurement, self.reconstruct.device)
        pose = align(measurement, self.reconstruct.psf) if self.check_consistency else None
        return replace(job, measurement=measurement, pose=pose, saturated=calibration.saturated_part(frame))

    @_step
    def _reconstruct(self, job: Job) -> Job:
        if job.measurement is None:
            return job
        reconstruct = self.reconstruct.at(job.pose) if job.pose else self.reconstruct
        return replace(job, scene=reconstruct.on_device(job.measurement))

    @_step
    def _finish(self, job: Job) -> Job:
        if job.measurement is None or job.scene is None:
            return job
        result = self._consistency(job.measurement, job.scene, job.pose)
        content: dict[str, object] = {
            "method": self.method,
            "psf_hash": self.reconstruct.calibration.psf_hash,
            "origin": job.origin,
        }
        if job.overexposed:
            content["saturated"] = job.saturated
        if result:
            content |= {**asdict(result), "doubtful": result.doubtful}
        scene, sidecar = to_host(job.scene), job.output.with_suffix(".json")
        with as_image_error(sidecar):
            sidecar.unlink(missing_ok=True)  # an old sidecar must not stand beside the new picture
        if self.format in ("tiff", "npy"):
            write_linear(job.output, scene)
        else:
            write_picture(job.output, to_display(scene), bits=16 if self.format == "png16" else 8)
        write_json(sidecar, content)
        return replace(job, measurement=None, pose=None, scene=None, consistency=result)

    def _consistency(self, measurement: Measurement, scene: Scene, pose: Pose | None) -> Consistency | None:
        """Check a scene if requested; an `ImageError` unless the scene and the result are finite."""
        result, finite = None, bool(scene.isfinite().all())
        if finite and self.check_consistency:
            result = consistency(measurement, self.reconstruct.psf, scene, pose=pose)
            finite = all(map(math.isfinite, astuple(result)))
        if not finite:
            raise ImageError(
                "The reconstruction holds NaN, infinity or too large numbers: nothing is written. The capture's "
                f"brightest pixel is {measurement.amax():.3g}, where 1 is saturation. Scale it, or use another method."
            )
        return result

    @cached_property
    def _settings_hash(self) -> str:
        return settings_hash(self.reconstruct, self.format)

    def _exists(self, job: Job) -> bool:
        """Whether a job's picture is complete, of the same origin, and checked if that is requested."""
        content = _read_sidecar(job.output.with_suffix(".json"))
        checked = "doubtful" in content or not self.check_consistency
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


def _read_sidecar(path: Path) -> dict[str, object]:
    """Content of a sidecar file; empty if it is missing or not of this package."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) and "origin" in content else {}


def _read_output(path: Path) -> Tensor:
    if path.suffix == ".png":
        return read_picture(path)
    return torch.from_numpy(read_frame(path)).movedim(-1, 0)[None]
