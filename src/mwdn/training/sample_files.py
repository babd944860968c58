"""Cached samples on the disk: an interrupted run does not compute them again."""

import hashlib
import json
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor

from mwdn.io.files import as_parameter_error, atomic
from mwdn.version import __version__

FREE_PART = 0.5
"""Samples are kept only if they take at most this part of the disk's free space."""


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
        with suppress(OSError, SafetensorError, KeyError):
            content = load(self._file(row).read_bytes())  # not mapped: a file that shrinks would end the process
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
        """Whether so many bytes are a sensible part of the disk's free space."""
        disk = next(folder for folder in (self.run, *self.run.resolve().parents) if folder.exists())
        return size <= FREE_PART * shutil.disk_usage(disk).free

    def remove_others(self) -> None:
        """Remove the samples of other recipes, PSFs and photographs."""
        for folder in self.path.parent.glob("*"):
            if folder != self.path:
                shutil.rmtree(folder, ignore_errors=True)

    def remove(self) -> None:
        """Remove all samples."""
        shutil.rmtree(self.path.parent, ignore_errors=True)

    def _file(self, row: int) -> Path:
        return self.path / f"{row:06}.safetensors"
