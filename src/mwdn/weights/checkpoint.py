"""Checkpoints: safetensors with the name and options to build the network again. Nothing is pickled."""

import json
from pathlib import Path
from pickle import UnpicklingError
from textwrap import shorten
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from mwdn.errors import CheckpointError, ParameterError
from mwdn.io.files import atomic
from mwdn.networks import build
from mwdn.version import __version__
from mwdn.weights.authors import is_authors, load_authors

SUFFIXES = frozenset({".safetensors", ".pt", ".pth", ".tar", ".ckpt"})
"""Suffixes of weight files."""


def save_network(
    path: str | Path,
    network: nn.Module,
    name: str,
    options: dict[str, Any],
    **metadata: Any,  # noqa: ANN401
) -> None:
    """Write a network's weights, atomically.

    Args:
        path: ends in ``.safetensors``.
        network: as built by ``build(name, **options)``.
        name: of the network.
        options: of the network; plain values that JSON can hold.
        **metadata: further entries, for example the recipe, the PSF's hash, metrics.

    Raises:
        CheckpointError: the path has another suffix.
    """
    if Path(path).suffix != ".safetensors":
        raise CheckpointError(f"`{path}` must end in .safetensors, not '{Path(path).suffix}'. Rename it.")
    header = {"version": __version__, **metadata, "name": name, "options": options}
    tensors = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    with atomic(Path(path)) as temporary:
        save_file(tensors, temporary, metadata={"mwdn": json.dumps(header)})


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The metadata that `save_network` stored: name, options, version and more.

    Raises:
        CheckpointError: the file is no checkpoint of this package.
    """
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get("mwdn")
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"`{path}` cannot be read as safetensors: {error}.") from error
    if text is None:
        raise CheckpointError(f"`{path}` was not written by mwdn: its metadata names no network. Use `save_network`.")
    try:
        header = json.loads(text)
    except json.JSONDecodeError as error:
        raise CheckpointError(
            f"The metadata of `{path}` is damaged: {error}. Copy it from its source again."
        ) from error
    if not (
        isinstance(header, dict) and isinstance(header.get("name"), str) and isinstance(header.get("options"), dict)
    ):
        raise CheckpointError(f"The metadata of `{path}` must hold a name and options. Save it with `save_network`.")
    return header


def load_checkpoint(path: str | Path) -> nn.Module:
    """Load a network from a checkpoint, on the CPU, in evaluation mode.

    Args:
        path: a checkpoint of this package (``.safetensors``), or of the MWDN authors (``.tar`` and the like, read
            without unpickling code).

    Raises:
        CheckpointError: the file is damaged, has an unknown layout, or its weights do not fit its network.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"No checkpoint at `{path}`. Check the name; the current folder is `{Path.cwd()}`.")
    if path.suffix != ".safetensors":
        return load_authors(_read_foreign(path)).eval()
    header = read_metadata(path)
    try:
        options = {key: value for key, value in header["options"].items() if key != "outputs"}
        network = build(header["name"], **options)
    except (TypeError, ParameterError) as error:
        version = header.get("version", "unknown")
        raise CheckpointError(
            f"`{path}`, of mwdn {version}, has a network that cannot be built: {error} Update mwdn."
        ) from error
    with safe_open(path, framework="pt") as file:
        state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    try:
        network.load_state_dict(state)  # converts the bundled float16 weights to float32
    except RuntimeError as error:
        raise CheckpointError(
            f"`{path}` does not fit the network '{header['name']}' it names: {first_difference(error)}. Copy it again."
        ) from error
    not_finite = [key for key, value in network.state_dict().items() if not value.isfinite().all()]
    if not_finite:
        raise CheckpointError(f"`{path}` holds NaN or infinity, `{not_finite[0]}` first. Use an earlier checkpoint.")
    return network.eval()


def read_plain(path: Path) -> Any:  # noqa: ANN401
    """Read a file of `torch.save`, on the CPU, without running code from it.

    Raises:
        CheckpointError: the file is damaged, or holds more than plain values.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged files
        # Without torch's message, which is ten lines long and suggests unpickling the file nevertheless.
        objects = isinstance(error, UnpicklingError) and "Unsupported operand" not in str(error)
        why = "it holds objects, whose code is not run" if objects else "it is damaged, or of another format"
        raise CheckpointError(
            f"`{path}` cannot be read as plain weights: {why}. Copy it again, or save its `state_dict()` alone."
        ) from error


def first_difference(error: Exception) -> str:
    """The first difference in an error of `load_state_dict`, which lists every key, in one line."""
    return shorten(str(error).partition(":\n")[2] or str(error), 200, placeholder=" ...").rstrip(".")


def _read_foreign(path: Path) -> dict[str, Tensor]:
    content = read_plain(path)
    state = content.get("net_state_dict", content) if isinstance(content, dict) else {}
    state = state if isinstance(state, dict) else {}
    state = {str(key).removeprefix("module."): value for key, value in state.items() if isinstance(value, Tensor)}
    if not is_authors(state):
        raise CheckpointError(
            f"`{path}` is neither a checkpoint of mwdn (.safetensors) nor one of the MWDN authors "
            f"(`net_state_dict` with `delta` and `inc.double_conv.*`). It holds: {', '.join(list(state)[:5])} ..."
        )
    return state
