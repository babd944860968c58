"""What a stopped run needs to go on as if nothing had happened: every tensor of it, in one safetensors file."""

import json
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor, nn

from mwdn.errors import CheckpointError
from mwdn.io.files import atomic

Header = dict[str, str]
"""Texts that stand in the file beside the tensors."""


def write_state(
    path: Path, header: Header, *, network: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer
) -> None:
    """Write weights, their running mean and the optimiser's moments, atomically.

    Raises:
        OSError: as for `mwdn.io.files.atomic`.
        SafetensorError: the disk refuses.
    """
    state = {
        f"{prefix}.{name}": value.contiguous()
        for prefix, module in (("network", network), ("average", average))
        for name, value in module.state_dict().items()
    }
    for name, parameter in network.named_parameters():
        for key, value in optimiser.state[parameter].items():
            state[f"optimiser.{name}.{key}"] = value.contiguous()
    with atomic(path) as temporary:
        save_file(state, temporary, metadata=header)


def read_state(path: Path, content: bytes) -> tuple[dict[str, Tensor], Header]:
    """Tensors and header of the bytes of a file.

    Raises:
        CheckpointError: they are damaged.
    """
    try:
        state = load(content)
    except SafetensorError as error:
        raise damaged(path, error) from error
    length = int.from_bytes(content[:8], "little")  # of a header in JSON, which follows
    return state, json.loads(content[8 : 8 + length]).get("__metadata__", {})


def damaged(path: Path, reason: object) -> CheckpointError:
    """What is raised of a state from which nothing can go on."""
    return CheckpointError(f"`{path}` is damaged: {reason}. Remove it to begin again.")


def restore(
    state: dict[str, Tensor], *, network: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer
) -> None:
    """Put the tensors of `write_state` back to where they were."""
    for prefix, module in (("network.", network), ("average.", average)):
        module.load_state_dict({key.removeprefix(prefix): v for key, v in state.items() if key.startswith(prefix)})
    for name, parameter in network.named_parameters():
        if f"optimiser.{name}.step" not in state:
            continue  # never had a gradient
        moments = {key: state[f"optimiser.{name}.{key}"].to(parameter.device) for key in ("exp_avg", "exp_avg_sq")}
        # Adam keeps its moments in the layout of the weights.
        form = torch.channels_last if parameter.ndim == 4 else torch.contiguous_format
        moments = {key: value.contiguous(memory_format=form) for key, value in moments.items()}
        optimiser.state[parameter] = {"step": state[f"optimiser.{name}.step"].cpu(), **moments}
