"""Checkpoints: safetensors with the name and options to build the network again. Nothing is pickled."""

import json
from pathlib import Path
from textwrap import shorten
from typing import Any

from safetensors.torch import save_file
from torch import Tensor, nn

from mwdn.errors import CheckpointError, ParameterError, reason
from mwdn.io.files import atomic
from mwdn.networks.empty import build_empty
from mwdn.version import __version__
from mwdn.weights.authors import is_authors, load_authors
from mwdn.weights.tensors import Header, check_shapes, fill, is_safetensors, read_header, read_tensors
from mwdn.weights.torch_file import read_plain

WEIGHT_SUFFIXES = frozenset({".safetensors", ".pt", ".pth", ".tar", ".ckpt"})
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
    return _metadata(Path(path), read_header(Path(path)))


def _metadata(path: Path, header: Header) -> dict[str, Any]:
    text = header.metadata.get("mwdn")
    if not isinstance(text, str):
        raise CheckpointError(f"`{path}` was not written by mwdn: its metadata names no network. Use `save_network`.")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError also: a number of over 4,300 digits
        raise CheckpointError(
            f"The metadata of `{path}` is damaged: {reason(error)}. Copy it from its source again."
        ) from error
    has_name = isinstance(content, dict) and isinstance(content.get("name"), str)
    if not (has_name and isinstance(content.get("options"), dict)):
        raise CheckpointError(f"The metadata of `{path}` must hold a name and options. Save it with `save_network`.")
    return content


def load_checkpoint(path: str | Path) -> nn.Module:
    """Load a network from a checkpoint, on the CPU, in evaluation mode.

    The network is first built without memory and compared with the shapes in the file: a file whose options need more
    memory than its tensors is refused before any is allocated.

    Args:
        path: a checkpoint of this package, or of the MWDN authors (``.tar`` and the like, read
            without unpickling code).

    Raises:
        CheckpointError: the file is damaged, has an unknown layout, or its weights do not fit its network.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"No checkpoint at `{path}`. Check the name; the current folder is `{Path.cwd()}`.")
    if not (path.suffix == ".safetensors" or is_safetensors(path)):
        return _load_foreign(path)
    header = read_header(path)
    metadata = _metadata(path, header)
    name = metadata["name"]
    try:
        options = {key: v for key, v in metadata["options"].items() if key != "outputs"}  # of earlier versions
        network = build_empty(name, **options)
    except (TypeError, ParameterError) as error:  # TypeError: `name` is one of the options, too
        version = shorten(str(metadata.get("version", "unknown")), 20)
        raise CheckpointError(
            f"`{path}`, of mwdn {version}, has a network that cannot be built: {shorten(str(error), 180)} Update "
            "mwdn, or install the package of the plugin that has it."
        ) from error
    shapes = {key: entry.shape for key, entry in header.entries.items()}
    check_shapes(network, shapes, f"`{path}` does not fit the network '{name}' it names")
    return fill(network, read_tensors(path, header), f"`{path}`")


def first_difference(error: Exception) -> str:
    """The first difference in an error of `load_state_dict`, which lists every key, in one line."""
    return shorten(str(error).partition(":\n")[2] or str(error), 200, placeholder=" ...").rstrip(".")


def _load_foreign(path: Path) -> nn.Module:
    """Load a checkpoint of the MWDN authors."""
    content = read_plain(path)
    state = content.get("net_state_dict", content) if isinstance(content, dict) else {}
    state = state if isinstance(state, dict) else {}
    state = {str(key).removeprefix("module."): value for key, value in state.items() if isinstance(value, Tensor)}
    if not is_authors(state):
        names = shorten(", ".join(key[:40] for key in list(state)[:5]), 80, placeholder=" ...")
        raise CheckpointError(
            f"`{path}` is neither a checkpoint of mwdn (.safetensors) nor one of the MWDN authors "
            f"(`net_state_dict` with `delta` and `inc.double_conv.*`). It holds: {names or 'nothing'}."
        )
    try:
        return load_authors(state).eval()
    except CheckpointError as error:
        raise CheckpointError(f"`{path}`: {error}") from error
