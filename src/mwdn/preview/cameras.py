"""Calibrations by name: the sample, those of the command line, and those that clients have stored."""

import hashlib
import re
import tempfile
import threading
import warnings
from collections import OrderedDict
from dataclasses import fields
from pathlib import Path
from typing import Any

from mwdn.calibration import Calibration, FrameFormat, PsfFormat
from mwdn.errors import ImageError, MwdnError, ParameterError, UnknownNameError
from mwdn.inference.capture_pipeline import PsfFile
from mwdn.io.arrays import at_most_pixels
from mwdn.io.files import atomic_write, is_full, write_json
from mwdn.io.reading import read_bytes, read_json, unexpected_content
from mwdn.io.toml import as_tuple
from mwdn.preview.limits import Limits, RefusedError
from mwdn.preview.samples import SAMPLE_CAMERA, sample_calibration

NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,39}")
CAMERA_OPTIONS = tuple(sorted(field.name for kind in (FrameFormat, PsfFormat) for field in fields(kind)))
"""Options of a calibration that a client may set: those that name no file."""

LIVE_CAMERA = "live"
"""Name of the live camera's calibration, which no client can take."""

KEPT_UPLOADS = 8
"""Calibrations of uploaded PSFs that are kept, for the next capture of the same camera."""


class StoredCameras:
    """Calibrations by name.

    Args:
        limits: of the server.
        folder: where stored calibrations are kept; in memory unless given.
        given: calibrations of the command line.
        psf_files: what the PSF's files of `given` tell, by the same names; those that are missing are unknown.
    """

    def __init__(
        self,
        limits: Limits,
        folder: Path | None = None,
        given: dict[str, Calibration] | None = None,
        psf_files: dict[str, PsfFile] | None = None,
    ) -> None:
        self.limits, self.folder, self.given = limits, folder, dict(given or {})
        self._lock = threading.Lock()
        self._stored: dict[str, Calibration] = {}
        self._given_files = dict(psf_files or {})
        self._stored_files: dict[str, PsfFile] = {}
        self._recent: OrderedDict[str, Calibration] = OrderedDict()
        if folder is not None and folder.is_dir():
            for entry in sorted(folder.glob("*.json")):
                try:
                    self._load(entry)
                except MwdnError as error:  # the others are served
                    warnings.warn(f"The stored camera `{entry}` is left out: {error}", stacklevel=2)

    def _load(self, entry: Path) -> None:
        content = read_json(entry)
        with unexpected_content(entry):
            name, options = str(content["name"]), content["options"]
            psf = read_bytes(entry.with_suffix(".psf"), most=self.limits.upload_bytes)
            self._stored[_checked_name(name)] = self.calibrate(psf, options)
            self._stored_files[name] = PsfFile.read(psf)

    def list(self) -> list[dict[str, Any]]:
        """For JSON: name, kind, size and PSF hash of each."""
        with self._lock:
            named = [("given", *item) for item in self.given.items()]
            named += [("stored", *item) for item in sorted(self._stored.items())]
        named.append(("sample", SAMPLE_CAMERA, sample_calibration()))
        return [describe(name, kind, calibration) for kind, name, calibration in named]

    def described(self, name: str) -> dict[str, Any]:
        """For JSON: one of the `list`.

        Raises:
            RefusedError: no such name.
        """
        calibration = self.get(name)
        with self._lock:
            kind = "given" if name in self.given else "stored" if name in self._stored else "sample"
        return describe(name, kind, calibration)

    def get(self, name: str) -> Calibration:
        """A calibration by its name.

        Raises:
            RefusedError: no such name.
        """
        with self._lock:
            known = {**self._stored, **self.given}
        if name == SAMPLE_CAMERA and name not in known:
            return sample_calibration()
        if name not in known:
            raise RefusedError(404, str(UnknownNameError("camera", name, [*known, SAMPLE_CAMERA])))
        return known[name]

    def psf_file(self, name: str) -> PsfFile:
        """What the PSF's file of a calibration tells besides its pixels; nothing if its PSF is not from a file."""
        with self._lock:
            return {**self._stored_files, **self._given_files}.get(name, PsfFile())

    def calibrate(self, psf: bytes, options: dict[str, Any]) -> Calibration:
        """A calibration from the file of a PSF.

        Args:
            psf: PNG, TIFF, NPY ...
            options: of `CAMERA_OPTIONS`.

        Raises:
            MwdnError: the file or an option is wrong. The message names no path.
        """
        options = checked_camera(options)
        key = hashlib.sha256(psf + repr(sorted(options.items())).encode()).hexdigest()
        with self._lock:
            if key in self._recent:
                self._recent.move_to_end(key)
                return self._recent[key]
        calibration = read_upload(
            psf, "psf", self.limits.frame_pixels, lambda path: Calibration.from_file(path, **options)
        )
        check_pixels("psf", calibration.size, self.limits)
        with self._lock:
            self._recent[key] = calibration
            while len(self._recent) > KEPT_UPLOADS:
                self._recent.popitem(last=False)
        return calibration

    def give(self, name: str, calibration: Calibration) -> None:
        """Add or replace a calibration of the server itself."""
        with self._lock:
            self.given[name] = calibration

    def add(self, name: str, psf: bytes, options: dict[str, Any]) -> Calibration:
        """Store a calibration.

        Raises:
            RefusedError: the name is taken, the server's limit is reached, or its disk cannot be written.
            MwdnError: as for `calibrate`.
        """
        _checked_name(name)
        calibration = self.calibrate(psf, options)
        with self._lock:
            if name in (*self.given, *self._stored, SAMPLE_CAMERA, LIVE_CAMERA):
                raise RefusedError(409, f"`name` ({name}) is taken. Remove that camera, or choose another name.")
            if len(self._stored) >= self.limits.cameras:
                raise RefusedError(
                    409, f"{len(self._stored)} cameras are stored already, the server's limit. Remove one."
                )
            if self.folder is not None:
                self._write(name, psf, options)
            self._stored[name], self._stored_files[name] = calibration, PsfFile.read(psf)
        return calibration

    def _write(self, name: str, psf: bytes, options: dict[str, Any]) -> None:
        entry = self._entry(name)
        try:
            with atomic_write(entry.with_suffix(".psf")) as temporary:
                temporary.write_bytes(psf)
            write_json(entry, {"name": name, "options": options})  # last: without it there is no camera
        except ImageError as error:
            why = getattr(error.__cause__, "strerror", "") or "its disk may be full"  # without the server's paths
            status = 507 if is_full(error.__cause__) else 500
            raise RefusedError(status, f"The server cannot store the camera: {why}.") from error

    def remove(self, name: str) -> None:
        """Remove a stored calibration.

        Raises:
            RefusedError: no such name, or it is not a stored one.
        """
        self.get(name)
        with self._lock:
            if name not in self._stored:
                raise RefusedError(409, f"`name` ({name}) is of the server itself and cannot be removed.")
            del self._stored[name], self._stored_files[name]
            if self.folder is not None:
                entry = self._entry(name)
                entry.unlink(missing_ok=True)
                entry.with_suffix(".psf").unlink(missing_ok=True)

    def _entry(self, name: str) -> Path:
        """File of a stored camera, named by a hash: nothing that a client sends becomes a path."""
        assert self.folder is not None
        return self.folder / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.json"


def describe(name: str, kind: str, calibration: Calibration) -> dict[str, Any]:
    """A camera for JSON."""
    height, width = calibration.size
    colours = "RGB" if calibration.psf.shape[1] == 3 else "grey"
    about = {"name": name, "kind": kind, "height": height, "width": width}
    return {**about, "colours": colours, "psf_hash": calibration.psf_hash}


def _checked_name(name: str) -> str:
    if not NAME.fullmatch(name):
        raise ParameterError(f"`name` ({name[:60]!r}) must be 1 to 40 letters a to z, digits and hyphens: `my-camera`.")
    return name


def checked_camera(options: dict[str, Any]) -> dict[str, Any]:
    """Options of a calibration, with tuples for the lists of JSON.

    Raises:
        UnknownNameError: a name is none of `CAMERA_OPTIONS`; files are no options here.
    """
    for name in options:
        if name not in CAMERA_OPTIONS:
            raise UnknownNameError("option of a camera", name, CAMERA_OPTIONS)
    return {name: as_tuple(value) for name, value in options.items()}


def check_pixels(what: str, size: tuple[int, int], limits: Limits) -> None:
    """Check the size of a measurement or a PSF.

    Raises:
        RefusedError: it has more pixels than the server reconstructs.
    """
    height, width = size
    if height * width > limits.pixels:
        raise RefusedError(
            413,
            f"`{what}` ({height} x {width}) has more than {limits.pixels:,} pixels, the server's limit. Bin or crop "
            'it: `calibration={"bin": 4}`.',
        )


def read_upload(data: bytes, what: str, most_pixels: int, read: Any) -> Any:  # noqa: ANN401
    """Read an uploaded file by one of the guarded readers, from a temporary file whose name no client knows.

    Args:
        data: the file.
        what: it is, as in the message of an error.
        most_pixels: of the frame.
        read: called with the path.

    Raises:
        MwdnError: the file is wrong.
    """
    with tempfile.TemporaryDirectory(prefix="mwdn-") as folder:
        path = Path(folder) / what
        path.write_bytes(data)
        try:
            with at_most_pixels(most_pixels):
                return read(path)
        except MwdnError as error:
            text = str(error).replace(str(path), what)
            raise type(error)(text) if type(error).__init__ is MwdnError.__init__ else ParameterError(text) from None
