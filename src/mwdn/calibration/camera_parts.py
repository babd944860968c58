"""Write a camera file together with the files that it names: all of them, or none."""

import hashlib
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from mwdn.calibration.camera_file import read_camera, write_camera
from mwdn.errors import ParameterError
from mwdn.io.files import as_parameter_error, atomic_write
from mwdn.io.images import write_frame
from mwdn.io.toml import read_toml
from mwdn.types import Frame

PART_KEYS = ("psf", "dark", "flat_field", "hot_pixels", "distance_psfs", "field_psfs")
"""Keys of a camera file whose files this module writes."""

_NAME = rf"-(?:{'|'.join(key.removesuffix('s').replace('_', '-') for key in PART_KEYS)})-[0-9a-f]{{8}}\.(?:tif|png)"
"""What follows the camera file's stem in the name of a picture."""


def write_camera_with_parts(
    path: Path, content: Mapping[str, Any], parts: Mapping[str, Frame | Sequence[Frame]]
) -> dict[str, Any]:
    """Write a camera file and its pictures.

    A picture's name ends in a hash of its numbers: ``camera-psf-1a2b3c4d.tif``. So the pictures of an existing camera
    file stay until the new file has replaced it atomically; then those that no camera file of the folder names are
    removed: a copy of the camera file keeps its pictures. Pictures that were written for another camera file are
    copied, because that file may remove them.

    Args:
        path: the camera file.
        content: its values, see `mwdn.calibration.camera_file.KEYS`.
        parts: frames (H, W, C), or lists of them, by the key that names their file.

    Returns:
        The content, with the paths of the parts.

    Raises:
        MwdnError: a file cannot be written. Then nothing has changed.
    """
    before = _own_parts(path)
    written: list[Path] = []
    try:
        others = {key: content[key] for key in PART_KEYS if content.get(key) and key not in parts}
        content = {**content, **{key: _copied(path, value, written) for key, value in others.items()}}
        for key, frames in parts.items():
            if isinstance(frames, np.ndarray):
                content = {**content, key: _write(path, key, frames, written)}
            else:
                content = {**content, key: tuple(_write(path, key, frame, written) for frame in frames)}
        write_camera(path, content)
    except BaseException:
        for file in written:
            file.unlink(missing_ok=True)
        raise
    _remove_unnamed(before, path.parent)
    return dict(content)


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """A camera file that is made in several steps, in a hidden folder beside ``path``.

    At the end it replaces ``path`` atomically, with the pictures that this module has written for it. Until then, and
    if anything fails, ``path`` stays as it is.

    Raises:
        ParameterError: the folder cannot be written.
    """
    before = _own_parts(path)
    with as_parameter_error(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = TemporaryDirectory(prefix=f".{path.stem}-", dir=path.parent)
    with folder as name:
        draft = Path(name) / path.name
        yield draft
        moved = {file: path.with_name(file.name) for file in _own_parts(draft)}
        content = {key: _renamed(value, moved) for key, value in read_camera(draft).items() if key != "psf_sha256"}
        with as_parameter_error(path.parent):
            for file, new in moved.items():
                file.replace(new)
        try:
            write_camera(path, content)
        except BaseException:
            _remove({*moved.values()} - before)
            raise
    _remove_unnamed(before, path.parent)


def _renamed(value: Any, moved: Mapping[Path, Path]) -> Any:  # noqa: ANN401
    if isinstance(value, tuple):
        return tuple(_renamed(each, moved) for each in value)
    return moved.get(value, value) if isinstance(value, Path) else value


def _remove_unnamed(files: set[Path], folder: Path) -> None:
    """Remove files that no camera file of the folder names; none if one of these cannot be read."""
    if not files:
        return
    cameras = [path for path in folder.iterdir() if path.suffix.lower() == ".toml"]
    with suppress(ParameterError):
        named = {part.resolve() for path in cameras for part in _named_parts(path)}
        _remove({file for file in files if file.resolve() not in named})


def _remove(files: set[Path]) -> None:
    for file in files:
        with suppress(OSError):
            file.unlink()


def _write(path: Path, key: str, frame: Frame, written: list[Path]) -> Path:
    suffix = ".png" if frame.dtype == np.uint8 else ".tif"
    digest = hashlib.sha256(repr(frame.shape).encode() + np.ascontiguousarray(frame).tobytes()).hexdigest()[:8]
    name = key.removesuffix("s").replace("_", "-")
    file = path.with_name(f"{path.stem}-{name}-{digest}{suffix}")
    if not file.exists():
        written.append(file)
    write_frame(file, frame)
    return file


def _copied(path: Path, value: Any, written: list[Path]) -> Any:  # noqa: ANN401
    """A path, or several, of a camera file; of the pictures of another camera file those of their copies."""
    if not isinstance(value, str | Path):
        return tuple(_copied(path, each, written) for each in value)
    name = re.fullmatch(rf".+?({_NAME})", Path(value).name)
    copy = path.with_name(path.stem + name[1]) if name else Path(value)
    if copy.resolve() == Path(value).resolve() or not Path(value).is_file():
        return value
    if not copy.exists():
        written.append(copy)
    with atomic_write(copy) as temporary:
        shutil.copyfile(value, temporary)
    return copy


def _named_parts(path: Path) -> set[Path]:
    """Files that a camera file names.

    Raises:
        ParameterError: it cannot be read.
    """
    table = read_toml(path, "camera file") if path.is_file() else {}
    names: list[Any] = []
    for key in PART_KEYS:
        value = table.get(key, ())
        names += value if isinstance(value, list) else [value]
    return {path.parent / name for name in names if isinstance(name, str)}


def _own_parts(path: Path) -> set[Path]:
    """Files that a camera file names, and that this module has written for it."""
    pattern = re.compile(re.escape(path.stem) + _NAME)
    named: set[Path] = set()
    with suppress(ParameterError):
        named = _named_parts(path)
    return {file for file in named if file.parent == path.parent and pattern.fullmatch(file.name)}


def picture_of(defects: torch.Tensor) -> Frame:
    """A map of hot pixels (1, 1, H, W) as a picture (H, W, 1): 255 at hot pixels."""
    return np.ascontiguousarray(255 * defects[0].movedim(0, -1).numpy().astype(np.uint8))
