"""Captures to pictures in files: read, reconstructed, judged and written at the same time, by one process or many."""

import hashlib
import json
import math
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from mwdn.calibration.psf import SATURATED_PART
from mwdn.data.captures import read_capture
from mwdn.errors import ImageError, MwdnError, ParameterError
from mwdn.evaluation.consistency import Consistency, consistency
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import contact_sheet, thumbnail, to_display
from mwdn.io.files import as_image_error, path_resolver, write_json
from mwdn.io.images import read_frame, read_picture, write_linear, write_picture
from mwdn.runtime import distributed
from mwdn.runtime.streams import prefetch
from mwdn.runtime.transfers import to_device, to_host
from mwdn.solvers import Pose, align
from mwdn.types import Measurement, Scene
from mwdn.version import __version__

Format = Literal["png", "png16", "tiff", "npy"]
"""``png`` and ``png16`` are sRGB for people; ``tiff`` and ``npy`` hold the linear float32 values."""

_SUFFIX = {"png": ".png", "png16": ".png", "tiff": ".tif", "npy": ".npy"}
SUMMARY = "summary.png"
SHOWN = 12
"""Captures on the summary: the first ones."""


def output_name(capture: str | Path, form: Format) -> str:
    """Name of a capture's reconstruction: its own, with another suffix."""
    return Path(capture).stem + _SUFFIX[form]


def check_outputs(
    captures: Sequence[str | Path], out: Path, form: Format, *, protected: Iterable[Path | None] = ()
) -> None:
    """Check that every capture has a place of its own in ``out``.

    Raises:
        ParameterError: two captures would go to one file, one would overwrite an input or a ``.json`` of somebody
            else, or ``out`` is a file.
    """
    if out.exists() and not out.is_dir():
        raise ParameterError(f"`{out}` must be a folder, but is a file. Choose another one: `--out`.")
    real = path_resolver()
    inputs = {real(str(path)) for path in (*captures, *protected) if path is not None}

    def check(output: str) -> None:
        if real(output) in inputs:
            raise ParameterError(f"`{output}` would overwrite an input. Choose another folder: `--out`.")

    there = {path.name for path in out.glob("*.json")}
    check(str(out / SUMMARY))
    seen = {SUMMARY: "the summary picture"}
    start = str(out / "x").removesuffix("x")
    for capture in captures:
        name = output_name(capture, form)
        beside = name.removesuffix(_SUFFIX[form]) + ".json"
        check(start + name)
        check(start + beside)
        if beside in there and not _read_beside(out / beside):
            raise ParameterError(f"`{start}{beside}` is not of mwdn and would be lost. Choose another folder: `--out`.")
        if name in seen:
            raise ParameterError(
                f"`{capture}` and {seen[name]} would both be written to `{start}{name}`. Reconstruct them into "
                "two folders: `--out`."
            )
        seen[name] = f"`{capture}`"


@dataclass(frozen=True)
class Job:
    """One capture on its way to a picture.

    Args:
        capture: its file.
        output: the picture's file.
        number: of the capture, from 0.
        origin: of what the picture is made, see `Batch.origin`.
        measurement: (1, C, H, W); it and the next two are there only between the steps that need them.
        pose: of the PSF, if the picture is judged.
        scene: (1, C, H, W).
        kept: the picture was there before.
        saturated: part of the capture's pixels, see `Calibration.saturated_part`.
        trust: how far to trust the picture, if it is judged.
        error: why there is no picture.
    """

    capture: Path
    output: Path
    number: int = 0
    origin: str = ""
    measurement: Measurement | None = None
    pose: Pose | None = None
    scene: Scene | None = None
    kept: bool = False
    saturated: float = 0.0
    trust: Consistency | None = None
    error: MwdnError | None = None

    @property
    def overexposed(self) -> bool:
        """Whether so much is cut off that even the right PSF may be doubted."""
        return self.saturated > SATURATED_PART


def _step(work: Callable[["Batch", Job], Job]) -> Callable[["Batch", Job], Job]:
    """One that ends a job with the error that concerns this capture alone."""

    def step(darkroom: "Batch", job: Job) -> Job:
        try:
            return work(darkroom, job)
        except MwdnError as error:
            return replace(job, measurement=None, pose=None, scene=None, error=error)

    return step


@dataclass(frozen=True)
class Batch:
    """Where the captures of one camera become pictures, by one method, in one folder.

    Beside each picture is a ``.json`` that says how far to trust it and of what it was made. It is written after the
    picture: where it is, the picture is whole.

    Args:
        reconstruct: the method and the camera.
        method: its name, for people.
        out: folder of the pictures.
        form: of their files.
        judge: find how far to trust each picture, which may take longer than to make it.
        resume: leave out each capture whose picture is there, of the same `origin`, and judged if this one is to be.
    """

    reconstruct: Reconstructor
    method: str
    out: Path
    form: Format = "png"
    judge: bool = True
    resume: bool = False

    def run(self, captures: Sequence[str | Path]) -> Generator[Job, None, None]:
        """Turn captures into pictures, in their order; of several processes each turns those that no other does."""
        numbers = distributed.work_queue(len(captures))
        jobs = (Job(Path(captures[n]), self.out / output_name(captures[n], self.form), n) for n in numbers)
        # To find the pose and to judge takes longer than most methods: on a CPU the three steps share its cores.
        with prefetch(self._read, jobs) as read, prefetch(self._finish, map(self._reconstruct, read)) as finished:
            yield from finished

    @_step
    def _read(self, job: Job) -> Job:
        job = replace(job, origin=self.origin(job.capture))
        if self.resume and self._is_there(job):
            return replace(job, kept=True)
        calibration = self.reconstruct.calibration
        frame = calibration.frames.read(job.capture)
        measurement = calibration.correct(frame)
        if measurement.amax() <= 0:
            raise ImageError("The sensor saw no light: no pixel is brighter than the dark frame, or black.")
        measurement = to_device(measurement, self.reconstruct.device)
        pose = align(measurement, self.reconstruct.psf) if self.judge else None
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
        beside, trust = job.output.with_suffix(".json"), self._judged(job.measurement, job.scene, job.pose)
        content: dict[str, object] = {
            "method": self.method,
            "psf_hash": self.reconstruct.calibration.psf_hash,
            "origin": job.origin,
        }
        if job.overexposed:
            content["saturated"] = job.saturated
        if trust:
            content |= {**asdict(trust), "doubtful": trust.doubtful}
        scene = to_host(job.scene)
        with as_image_error(beside):
            beside.unlink(missing_ok=True)  # or it would vouch for another picture than it was written for
        if self.form in ("tiff", "npy"):
            write_linear(job.output, scene)
        else:
            write_picture(job.output, to_display(scene), bits=16 if self.form == "png16" else 8)
        write_json(beside, content)
        return replace(job, measurement=None, pose=None, scene=None, trust=trust)

    def _judged(self, measurement: Measurement, scene: Scene, pose: Pose | None) -> Consistency | None:
        """How far to trust a scene, if that is asked; an `ImageError` unless the scene and the answer are finite."""
        trust, finite = None, bool(scene.isfinite().all())
        if finite and self.judge:
            trust = consistency(measurement, self.reconstruct.psf, scene, pose=pose)
            finite = all(map(math.isfinite, astuple(trust)))
        if not finite:
            raise ImageError(
                "The reconstruction holds NaN, infinity or too large numbers: nothing is written. The capture's "
                f"brightest pixel is {measurement.amax():.3g}, where 1 is saturation. Scale it, or take another method."
            )
        return trust

    def origin(self, capture: Path) -> str:
        """16 hexadecimal digits that are others if anything is another that a picture depends on.

        This is the method with its weights, the calibration, the format, the version of this package, and the size of
        the capture's file and when it was last changed.
        """
        try:
            found = capture.stat()
        except OSError:  # to read it will say why
            return ""
        return _digest(self._setting, found.st_size, found.st_mtime_ns)

    @cached_property
    def _setting(self) -> str:
        method, calibration, engine = self.reconstruct.method, self.reconstruct.calibration, self.reconstruct.engine
        camera = {field.name: getattr(calibration, field.name) for field in fields(calibration)}
        how: tuple[object, ...] = (method,)
        if isinstance(method, nn.Module):
            options = {name: value for name, value in vars(method).items() if name[0] != "_"}
            how = (type(method).__name__, options, method.state_dict(), engine and engine.precision)
        return _digest(__version__, self.form, camera, self.reconstruct.align, *how)

    def _is_there(self, job: Job) -> bool:
        content = _read_beside(job.output.with_suffix(".json"))
        judged = "doubtful" in content or not self.judge
        return judged and content.get("origin") == job.origin != "" and job.output.is_file()

    def summarise(self, captures: Iterable[str | Path]) -> None:
        """Show the first captures beside their pictures, as they are on the disk; nothing if there is none.

        Raises:
            ImageError: the summary cannot be written.
        """
        rows: list[list[Tensor]] = []
        for capture in captures:
            output = self.out / output_name(capture, self.form)
            if len(rows) == SHOWN:
                break
            if output.is_file():
                with suppress(MwdnError):
                    pair = read_capture(Path(capture), self.reconstruct.calibration), _read_back(output)
                    rows.append([thumbnail(picture) for picture in pair])
        if rows:
            titles = ["measurement", f"reconstruction ({Path(self.method).name})"]
            write_picture(self.out / SUMMARY, contact_sheet(rows, titles))


def _read_beside(path: Path) -> dict[str, object]:
    """What a ``.json`` says of the picture that it lies beside; nothing if it is not there, or of somebody else."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) and "origin" in content else {}


def _read_back(path: Path) -> Tensor:
    if path.suffix == ".png":
        return read_picture(path)
    return torch.from_numpy(read_frame(path)).movedim(-1, 0)[None]


def _digest(*parts: object) -> str:
    """First 16 hexadecimal digits of the SHA-256 of tensors' bytes and other things' `repr`, in mappings, too."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Mapping):
            digest.update(_digest(*(each for item in part.items() for each in item)).encode())
        elif isinstance(part, Tensor):
            digest.update(repr((part.shape, part.dtype)).encode() + part.cpu().contiguous().numpy().tobytes())
        else:
            digest.update(repr(part).encode() + b"\0")
    return digest.hexdigest()[:16]
