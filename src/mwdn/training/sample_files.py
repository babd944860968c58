"""Cached samples on the disk: an interrupted run does not compute them again."""

import hashlib
import json
import re
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor

from mwdn.errors import ImageError
from mwdn.io.files import as_parameter_error, atomic
from mwdn.io.reading import read_bytes
from mwdn.version import __version__

_SAMPLE_BYTES = 2**30
"""Most bytes of a sample: 1 GiB; 20 pictures of 2000 x 2000 in half precision have a quarter."""

FREE_PART = 0.5
"""Samples are kept only if they take at most this part of the disk's free space."""

_FOLDER = re.compile("[0-9a-f]{16}")
_FILE = re.compile(r"\d{6,}\.safetensors|\.mwdn-.*")


class Sample(NamedTuple):
    """A cached sample; pictures in half precision.

    Args:
        estimates: (C * pictures, H, W), what the network computes before its learned part.
        unit: (1, 1, 1), the scale of the network's correction.
        scene: (C, H, W).
    """

    estimates: Tensor
    unit: Tensor
    scene: Tensor


class SampleFiles:
    """Samples of one run in the folder ``samples`` of its folder, one file each, until the run ends.

    Args:
        folder: of the run.
        identity: everything that the samples depend on; those of another identity are removed.
    """

    def __init__(self, folder: Path, identity: dict[str, Any]) -> None:
        content = json.dumps([__version__, identity], sort_keys=True)
        self.run = folder
        self.path = folder / "samples" / hashlib.sha256(content.encode()).hexdigest()[:16]

    def read(self, row: int) -> Sample | None:
        """A sample; ``None`` if there is no whole file of it."""
        with suppress(ImageError, SafetensorError, KeyError):
            # Not mapped: a file that shrinks would end the process.
            content = load(read_bytes(self._file(row), most=_SAMPLE_BYTES))
            return Sample(*(content[name] for name in Sample._fields))
        return None

    def write(self, row: int, sample: Sample) -> None:
        """Write a sample, atomically.

        Raises:
            ParameterError: the folder cannot be written to.
        """
        with as_parameter_error(self.run), atomic(self._file(row)) as temporary:
            save_file({name: value.cpu() for name, value in sample._asdict().items()}, temporary)

    def fits(self, size: int) -> bool:
        """Whether ``size`` bytes are at most `FREE_PART` of the disk's free space."""
        disk = next(folder for folder in (self.run, *self.run.resolve().parents) if folder.exists())
        return size <= FREE_PART * shutil.disk_usage(disk).free

    def remove_others(self) -> None:
        """Remove the samples of other recipes, PSFs and photographs."""
        for folder in self._folders():
            if folder != self.path:
                _remove(folder)

    def remove(self) -> None:
        """Remove all samples."""
        for folder in self._folders():
            _remove(folder)
        with suppress(OSError):  # it is missing, or holds other files
            self.path.parent.rmdir()

    def _folders(self) -> list[Path]:
        """Folders of samples, of any identity; no others, and no links to folders elsewhere."""
        if self.path.parent.is_symlink():
            return []
        return [path for path in self.path.parent.glob("*") if _FOLDER.fullmatch(path.name) and not path.is_symlink()]

    def _file(self, row: int) -> Path:
        return self.path / f"{row:06}.safetensors"


def _remove(folder: Path) -> None:
    """Remove a folder of samples, unless it also holds other files: these stay."""
    with suppress(OSError):
        for path in folder.iterdir():
            if _FILE.fullmatch(path.name):
                path.unlink()
        folder.rmdir()
