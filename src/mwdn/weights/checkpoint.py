"""Networks in files: safetensors with what it takes to build them again. Nothing is pickled."""

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
"""Suffixes of files that hold weights."""


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
        options: it was built with; plain values that JSON can hold.
        **metadata: more to remember, for example the recipe, the PSF's hash, metrics, the version that trained it.

    Raises:
        CheckpointError: another suffix.
    """
    if Path(path).suffix != ".safetensors":
        raise CheckpointError(f"`{path}` must end in .safetensors, not '{Path(path).suffix}'. Rename it.")
    header = {"version": __version__, **metadata, "name": name, "options": options}
    tensors = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    with atomic(Path(path)) as temporary:
        save_file(tensors, temporary, metadata={"mwdn": json.dumps(header)})


def read_metadata(path: str | Path) -> dict[str, Any]:
    """What `save_network` stored beside the weights: name, options, version and more.

    Raises:
        CheckpointError: not a checkpoint of this package.
    """
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get("mwdn")
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"`{path}` cannot be read as safetensors: {error}.") from error
    if text is None:
        raise CheckpointError(f"`{path}` was not written by mwdn: it does not say which network it belongs to.")
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


def load_network(path: str | Path) -> nn.Module:
    """Build the network that a file describes, with its weights, on the CPU, in evaluation mode.

    Args:
        path: a checkpoint of this package (``.safetensors``), or one of the MWDN authors (``.tar`` and the like,
            read without unpickling code).

    Raises:
        CheckpointError: damaged, of unknown layout, or its weights do not fit its network.
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
            f"`{path}`, of mwdn {version}, names a network that cannot be built: {error} Update mwdn."
        ) from error
    with safe_open(path, framework="pt") as file:
        state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    try:
        network.load_state_dict(state)  # float16 in files that come with the package, float32 here
    except RuntimeError as error:
        raise CheckpointError(
            f"`{path}` does not fit the network '{header['name']}' it names: {first_difference(error)}. Copy it again."
        ) from error
    broken = [key for key, value in network.state_dict().items() if not value.isfinite().all()]
    if broken:
        raise CheckpointError(f"`{path}` holds NaN or infinity, `{broken[0]}` first. Take weights from before that.")
    return network.eval()


def read_plain(path: Path) -> Any:  # noqa: ANN401
    """What `torch.save` wrote, on the CPU, without running code from the file.

    Raises:
        CheckpointError: damaged, or it holds more than plain values.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged files
        # Of torch's own words none: they go on for ten lines, and advise to unpickle the file all the same.
        objects = isinstance(error, UnpicklingError) and "Unsupported operand" not in str(error)
        why = "it holds objects, whose code is not run" if objects else "it is damaged, or something else"
        raise CheckpointError(
            f"`{path}` cannot be read as plain weights: {why}. Copy it again, or save its `state_dict()` alone."
        ) from error


def first_difference(error: Exception) -> str:
    """What `load_state_dict` complains of first, on one line: it names every key on lines of their own."""
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
