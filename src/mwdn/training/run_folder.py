"""The folder of a run: its files, and which run they belong to."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from mwdn.errors import CheckpointError, ParameterError, shown
from mwdn.io.files import as_parameter_error, check_folder, refuse_foreign, write_text
from mwdn.io.reading import LOG_BYTES, TEXT_BYTES, open_regular, read_bytes
from mwdn.runtime import distributed
from mwdn.training.recipe import Recipe, with_current_names
from mwdn.training.sample_files import SampleFiles
from mwdn.training.training_state import Header, damaged, read_state
from mwdn.weights.tensors import read_header

MAKE_ROOM = "Make room and give the same command again: it resumes from the last saved state."
WEIGHT_NAMES = ("last", "best")
STATE_BYTES = 2**33
"""Limit of the bytes of a state: 8 GiB, twice what the largest network that is built needs (weights, average, two
moments)."""


def run_identity(recipe: Recipe, psf_hash: str, samples: str) -> dict[str, Any]:
    """Settings that must be the same when a run resumes; they are also stored in the checkpoints.

    Args:
        recipe: the experiment. Settings that do not change the weights are left out.
        psf_hash: of the calibration.
        samples: name of the task's samples.
    """
    tables = recipe.as_dict()
    del tables["schedule"]["checkpointing"]  # changes memory and time only
    del tables["sheet"]
    if not recipe.selfsupervised.consistency:
        del tables["selfsupervised"]
    # With random cameras the PSF is used for the validation only.
    return {"recipe": tables, "psf_hash": None if recipe.cameras.sizes else psf_hash, "pairs": samples}


class RunFolder:
    """Files of one run, protected from other runs: ``state.safetensors``, ``recipe.json``, ``log.jsonl``, weights.

    Only the first process reads and writes them; cached samples are written by the process that uses them.

    Args:
        path: of the folder, which is made if it is missing.
        identity: see `run_identity`.
    """

    def __init__(self, path: Path, identity: dict[str, Any]) -> None:
        self.path, self.identity = path, identity

    @property
    def state(self) -> Path:
        """File with the state from which a run resumes."""
        return self.path / "state.safetensors"

    def weights(self, name: str) -> Path:
        """File with the weights of the "last" or the "best" validation."""
        return self.path / f"{name}.safetensors"

    def samples(self, content: str) -> SampleFiles:
        """Cached samples of this run, made from files with this `mwdn.data.simulated.Samples.content`."""
        return SampleFiles(self.path, {**self.identity, "content": content})

    def samples_size(self) -> int:
        """Bytes of the cached samples on the disk."""
        return sum(file.stat().st_size for file in self.path.glob("samples/*/*"))

    def remove_samples(self) -> None:
        """Remove the cached samples after the last step. Each process may have its own disk."""
        self.samples("").remove()

    def read(self) -> tuple[dict[str, Tensor], Header] | None:
        """The saved state of this run, on all processes; ``None`` if there is none.

        Raises:
            CheckpointError: the state is damaged, or the folder holds another run.
        """
        content = distributed.broadcast(self._read_state)
        if content:
            state, header = read_state(self.state, content)
            self._check(header.get("identity", "null"))
            return state, header
        owner = distributed.broadcast(self._read_owner)
        if owner:
            self._check(owner.decode(errors="replace"))
        return None

    def _read_state(self) -> bytes:
        if not self.state.exists():
            return b""
        open_regular(self.state, CheckpointError).close()
        try:
            read_header(self.state)  # check the header first: another file may have any size
        except CheckpointError as error:
            raise damaged(self.state, "its header does not fit it") from error
        return read_bytes(self.state, most=STATE_BYTES, error=CheckpointError)

    def _read_owner(self) -> bytes:
        """Identity of the run whose weights are in the folder; empty without weights."""
        recipe = self.path / "recipe.json"
        if not any(self.weights(name).exists() for name in WEIGHT_NAMES):
            return b""
        if not recipe.exists():
            raise CheckpointError(
                f"`{self.path}` holds weights, but no recipe.json that says of which run. Choose another folder, "
                "`out`, or remove it."
            )
        return read_bytes(recipe, most=TEXT_BYTES, error=CheckpointError)

    def _check(self, owner: str) -> None:
        try:
            difference = _difference(_with_current_names(json.loads(owner)), json.loads(json.dumps(self.identity)))
        except (ValueError, RecursionError):
            difference = "its record is damaged"
        if difference:
            raise CheckpointError(
                f"`{self.path}` holds a run of another recipe or PSF, or on other pairs: {difference}. "
                "Choose another folder, `out`, or remove it."
            )

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other runs out of the folder; the lock ends with the process at the latest.

        Raises:
            ParameterError: another run is using the folder, it cannot be written to, or it holds files of the same
                names that are not of a run.
        """
        if distributed.rank() or sys.platform == "win32":
            yield
            return
        import fcntl

        check_folder(self.path)
        refuse_foreign(self.path, ("recipe.json", "log.jsonl", "validation.png"), b'"recipe"')
        self.path.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.path, os.O_RDONLY)  # the folder itself: a lock file would stay behind
        try:
            with suppress(OSError):  # of file systems without locks
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError as error:
                    raise ParameterError(
                        f"Another run is using `{self.path}`. Wait for its end, or choose another folder: `out`."
                    ) from error
            yield
        finally:
            os.close(handle)

    def claim(self, step: int) -> None:
        """Write the run's identity, and cut the log off after ``step``.

        An unwritable folder is thus reported before training, not at the first validation.

        Raises:
            ParameterError: another run is using the folder.
            MwdnError: it cannot be written to.
        """
        log = self.path / "log.jsonl"
        with self.lock():
            write_text(self.path / "recipe.json", json.dumps(self.identity, indent=2))
            # One line per step; those after the saved step will be written again.
            content = read_bytes(log, most=LOG_BYTES, error=ParameterError) if log.exists() else b""
            # Bytes of a damaged line that are not UTF-8 are replaced.
            write_text(log, b"".join(content.splitlines(keepends=True)[:step]).decode(errors="replace"))

    def log(self, line: dict[str, Any]) -> None:
        """Append a line to the log.

        Raises:
            ParameterError: the folder cannot be written to, for example because the disk is full.
        """
        with as_parameter_error(self.path, MAKE_ROOM), (self.path / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def _difference(there: Any, here: Any, name: str = "") -> str:  # noqa: ANN401
    """The first setting in which two identities differ, and its values; empty if they are equal."""
    if there == here:
        return ""
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return f"`{name.removeprefix('recipe.')}` is {shown(there)} there, {shown(here)} here"
    # From the end: other pairs change the number of validations in the recipe, too.
    keys = [key for key in reversed(here | there) if there.get(key) != here.get(key)]
    return _difference(there.get(keys[0]), here.get(keys[0]), f"{name}.{keys[0]}".removeprefix("."))


def _with_current_names(identity: Any) -> Any:  # noqa: ANN401
    """Identity of a run, which an earlier version may have written with former names of the recipe's keys."""
    if not (isinstance(identity, dict) and isinstance(identity.get("recipe"), dict)):
        return identity
    return {**identity, "recipe": with_current_names(identity["recipe"])}
