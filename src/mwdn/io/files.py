"""Files that are either wholly new or wholly old.

What the disk refuses is raised as its `OSError` by `atomic`, `save_png` and `save_linear`, and is told in the words of
this package by the others.
"""

import json
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError

from mwdn.errors import ImageError, ParameterError
from mwdn.types import FloatFrame, Frame


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Write a file so that nobody ever sees half of it.

    The file is written under a hidden name in the same folder, and renamed once all of it is on the disk. If
    anything fails before that, an existing ``path`` keeps its bytes and the hidden file is removed.

    Args:
        path: where the file shall be; folders that are missing on the way are created, and a symbolic link is
            followed rather than replaced.

    Yields:
        The name to write to: same folder and suffix as ``path``, unlike that of any other process.

    Raises:
        OSError: the folder cannot be written to, the disk is full, or ``path`` is a folder.
    """
    path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    # The stem is left out: a long one plus a token could pass the 255 bytes that a file system allows.
    temporary = path.with_name(f".mwdn-{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        yield temporary
        temporary.chmod(mode)  # that of any new file here: safetensors writes for its owner alone
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """`atomic`, which names the file in what the disk refuses.

    Raises:
        ImageError: the disk refuses.
    """
    with naming_file(path), atomic(Path(path)) as temporary:
        yield temporary


@contextmanager
def naming_file(path: str | Path) -> Iterator[None]:
    """Name a file in what the disk refuses.

    Raises:
        ImageError: it does.
    """
    try:
        yield
    except OSError as error:
        raise ImageError(f"`{path}` cannot be written: {error.strerror or error}. Choose another folder.") from error


def save_text(path: Path, text: str) -> None:
    """Write a text file, atomically.

    Raises:
        ImageError: the disk refuses.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a report as JSON, atomically.

    Raises:
        ImageError: the disk refuses.
    """
    save_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


@contextmanager
def writable(folder: Path, way_out: str = "Choose another one: `--out`.") -> Iterator[None]:
    """Say of which folder it is that the disk refuses something.

    Raises:
        ParameterError: the disk is full, or refuses otherwise.
    """
    try:
        yield
    except (OSError, SafetensorError) as error:  # safetensors has a type of its own for what the disk refuses
        reason = getattr(error, "strerror", None) or error
        raise ParameterError(f"`{folder}` must be a folder that can be written to: {reason}. {way_out}") from error


def check_folder(folder: Path) -> None:
    """Create a folder and see that it can be written to, before the work whose result it shall hold.

    Raises:
        ParameterError: it cannot.
    """
    with writable(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass


def refuse_overwrite(output: Path, *inputs: Path | None) -> None:
    """See that an output replaces none of the inputs.

    Raises:
        ParameterError: it is one of them.
    """
    for path in filter(None, inputs):
        if output.exists() and path.exists() and output.samefile(path):
            raise ParameterError(f"`{output}` would overwrite an input. Choose another name: `--out`.")


def resolver() -> Callable[[str], str]:
    """The same as `Path.resolve`, but each folder is looked at once: a million files take seconds, not minutes."""
    folders: dict[str, tuple[str, dict[str, str]]] = {}

    def look(folder: Path) -> tuple[str, dict[str, str]]:
        links: dict[str, str] = {}
        if folder.is_dir():
            with os.scandir(folder) as entries:
                links = {each.name: str(Path(each.path).resolve()) for each in entries if each.is_symlink()}
        return str(folder.resolve() / "x").removesuffix("x"), links

    def real(path: str) -> str:
        folder, name = os.path.split(path)
        if folder not in folders:
            folders[folder] = look(Path(folder))
        start, links = folders[folder]
        return links.get(name) or start + name

    return real


def save_png(path: Path, pixels: Frame) -> None:
    """Write a frame as PNG, atomically.

    Args:
        path: where the file shall be.
        pixels: (H, W, 1) or (H, W, 3), RGB, uint8 or uint16.

    Raises:
        OSError: as for `atomic`, or the frame has over a million rows or columns, which PNG writers refuse.
    """
    import cv2

    try:
        encoded, data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))
    except cv2.error as error:
        raise OSError(f"OpenCV: {error.err}") from error
    if not encoded:
        raise OSError(f"OpenCV cannot encode {pixels.shape[0]:,} x {pixels.shape[1]:,} pixels as PNG")
    with atomic(path) as temporary:
        temporary.write_bytes(data.tobytes())


def save_linear(path: Path, frame: FloatFrame) -> None:
    """Write a frame's float32 numbers as NPY or, by any other suffix, as TIFF, atomically.

    Args:
        path: where the file shall be.
        frame: (H, W, 1) or (H, W, 3), RGB.

    Raises:
        OSError: as for `atomic`.
    """
    with atomic(path) as temporary:
        if path.suffix.lower() == ".npy":
            with temporary.open("wb") as file:
                np.save(file, frame, allow_pickle=False)
        else:
            import tifffile

            tifffile.imwrite(temporary, frame, photometric="rgb" if frame.shape[-1] == 3 else "minisblack")
