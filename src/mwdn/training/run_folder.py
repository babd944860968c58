"""The folder of a run: whose it is, what it remembers, what it tells."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from mwdn.errors import CheckpointError, ParameterError
from mwdn.io.files import as_parameter_error, check_folder, write_text
from mwdn.runtime import distributed
from mwdn.training.recipe import with_current_names
from mwdn.training.training_state import Header, read_state

MAKE_ROOM = "Make room and give the same command again: it goes on from the last saved state."
WEIGHTS = ("last", "best")


class RunFolder:
    """Files of one run, which no other run replaces: ``state.safetensors``, ``recipe.json``, ``log.jsonl``, weights.

    The first process alone reads and writes.

    Args:
        path: of the folder; it need not be there.
        identity: what a run must agree with to be gone on with; JSON can hold it.
    """

    def __init__(self, path: Path, identity: dict[str, Any]) -> None:
        self.path, self.identity = path, identity

    @property
    def state(self) -> Path:
        """All that a stopped run needs."""
        return self.path / "state.safetensors"

    def weights(self, name: str) -> Path:
        """Those of the last validation, or of the best one."""
        return self.path / f"{name}.safetensors"

    def saved(self) -> tuple[dict[str, Tensor], Header] | None:
        """The state of this run, where it was stopped, on all processes; ``None`` where it has not begun.

        Raises:
            CheckpointError: the state is damaged, or the folder holds another run.
        """
        content = distributed.broadcast(self._state)
        if content:
            state, header = read_state(self.state, content)
            self._check(header.get("identity", "null"))
            return state, header
        owner = distributed.broadcast(self._owner)
        if owner:
            self._check(owner.decode(errors="replace"))
        return None

    def _state(self) -> bytes:
        return (self.state.read_bytes() or b"empty") if self.state.exists() else b""

    def _owner(self) -> bytes:
        """Identity of the run whose weights lie here, if there are any."""
        recipe = self.path / "recipe.json"
        if not any(self.weights(name).exists() for name in WEIGHTS):
            return b""
        return recipe.read_bytes() if recipe.exists() else b"null"

    def _check(self, owner: str) -> None:
        try:
            own = _with_current_names(json.loads(owner)) == json.loads(json.dumps(self.identity))
        except ValueError:
            own = False
        if not own:
            raise CheckpointError(
                f"`{self.path}` holds a run of another recipe or PSF, or on other pairs. "
                "Choose another folder, `--out`, or remove it."
            )

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other runs out meanwhile; where this process is killed they may come in.

        Raises:
            ParameterError: another run is here, or the folder refuses.
        """
        if distributed.rank() or sys.platform == "win32":
            yield
            return
        import fcntl

        check_folder(self.path)
        # The folder itself: a file to be locked would stay behind.
        handle = os.open(self.path, os.O_RDONLY)
        try:
            with suppress(OSError):  # of file systems that lock nothing
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError as error:
                    raise ParameterError(
                        f"Another run is at work in `{self.path}`. Wait until it has ended, or choose another folder: "
                        "`--out`."
                    ) from error
            yield
        finally:
            os.close(handle)

    def claim(self, step: int) -> None:
        """Write once, so that a folder that refuses is found now and not after an hour; the log ends at the step.

        Raises:
            ParameterError: another run is at work in it.
            MwdnError: it refuses.
        """
        log = self.path / "log.jsonl"
        with self.alone():
            write_text(self.path / "recipe.json", json.dumps(self.identity, indent=2))
            # One line a step; those after the saved step will be written again.
            lines = log.read_text(encoding="utf-8").splitlines(keepends=True) if log.exists() else []
            write_text(log, "".join(lines[:step]))

    def log(self, line: dict[str, Any]) -> None:
        """Add a line to the log.

        Raises:
            ParameterError: the disk is full, or refuses otherwise.
        """
        with as_parameter_error(self.path, MAKE_ROOM), (self.path / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def _with_current_names(identity: Any) -> Any:  # noqa: ANN401
    """Identity of a run of an earlier version, whose recipe may have former names of keys."""
    if not (isinstance(identity, dict) and isinstance(identity.get("recipe"), dict)):
        return identity
    return {**identity, "recipe": with_current_names(identity["recipe"])}
