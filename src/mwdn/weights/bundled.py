"""Trained networks by name: bundled with the package, or on the Hugging Face hub."""

from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import nn

from mwdn.arguments import checked
from mwdn.errors import CheckpointError, reason
from mwdn.runtime.requirement import require
from mwdn.weights.checkpoint import load_checkpoint, read_metadata, save_network
from mwdn.weights.growth import grown
from mwdn.weights.tensors import is_safetensors

BUNDLED = {
    "universal": "Any camera, no training, the best pictures: alignment, plug-and-play ADMM, U-Net.",
    "universal-small": "Any camera, no training, faster: no alignment, no plug and play.",
}
"""Bundled networks, for any camera. Model card: `mwdn/weights/README.md`."""

HUB = "hub:"
"""Prefix: ``hub:owner/name`` is model.safetensors of that repository, ``hub:owner/name/file`` another file."""

WEIGHTS_FILE = "model.safetensors"
"""Checkpoint in a folder of `mwdn.bridges.save_pretrained`, or in a repository on the hub."""

BEST = "best.safetensors"
"""Checkpoint in the folder of a training run."""

_FOLDER = Path(str(files("mwdn") / "weights"))


def bundled_file(name: str) -> Path:
    """Weights of the package: a network of `BUNDLED`, or ``room-light``, that of `mwdn.inference.room_light`."""
    return _FOLDER / f"{name}.safetensors"


def find_weights(name: str) -> Path | None:
    """File of a bundled network, of a folder with `WEIGHTS_FILE` or `BEST`, or of one on the hub, downloaded once.

    ``None`` for other names.

    Raises:
        CheckpointError: it is not on the hub, or the hub cannot be reached.
    """
    if name in BUNDLED:
        return bundled_file(name)
    for file in (WEIGHTS_FILE, BEST):
        path = Path(name) / file
        if path.is_file():
            return path
    return _download(name) if name.startswith(HUB) else None


def stored_metadata(method: str | Path) -> dict[str, Any] | None:
    """Metadata of the checkpoint that a path or a name of `find_weights` means; ``None`` for other methods.

    Raises:
        CheckpointError: as for `find_weights` and `read_metadata`.
    """
    path = find_weights(str(method)) or Path(method)
    return read_metadata(path) if path.is_file() and is_safetensors(path) else None


@checked
def load_network(name: str | Path) -> nn.Module:
    """Load a network on the CPU, in evaluation mode.

    Args:
        name: ``universal`` or ``universal-small``, ``hub:owner/name``, or the path of a checkpoint, of the folder of a
            training run, or of one that `mwdn.bridges.save_pretrained` wrote.

    Raises:
        CheckpointError: no such file, a damaged one, or weights that do not fit their network.
    """
    return load_checkpoint(find_weights(str(name)) or name)


def _download(name: str) -> Path:
    owner, _, rest = name.removeprefix(HUB).partition("/")
    repository, _, file = rest.partition("/")
    if not (owner and repository):
        raise CheckpointError(f"`{name}` must be hub:owner/name or hub:owner/name/file.safetensors.")
    require("huggingface_hub", "hub", purpose=f"`{name}`")
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        return Path(hf_hub_download(f"{owner}/{repository}", file or WEIGHTS_FILE))
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, OSError, ValueError) as error:
        raise CheckpointError(
            f"`{name}` cannot be fetched from the hub: {reason(error)}. Check the name and the network, or "
            "download the file and give its path."
        ) from error


def bundle(checkpoint: Path, out: Path, denoiser: Path | None = None) -> None:
    """Write a checkpoint with float16 weights and its whole metadata.

    Args:
        checkpoint: of a network.
        out: the file to write.
        denoiser: checkpoint of a denoiser to replace the network's own; it may have fewer inputs (the noise level
            only).

    Raises:
        CheckpointError: a checkpoint cannot be used, or a weight exceeds the range of float16.
    """
    header = read_metadata(checkpoint)
    network = load_checkpoint(checkpoint)
    if denoiser is not None:
        try:
            own = network.get_submodule("denoiser")
            own.load_state_dict(grown(load_checkpoint(denoiser).state_dict(), own))
        except (AttributeError, RuntimeError) as error:
            raise CheckpointError(f"`{checkpoint}` has no denoiser like that of `{denoiser}`: {error}") from error
    network = network.half()
    if not all(torch.isfinite(value).all() for value in network.state_dict().values()):
        raise CheckpointError(f"`{checkpoint}` holds weights beyond the range of float16, 65504.")
    save_network(out, network, header.pop("name"), header.pop("options"), **header)
