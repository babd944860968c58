"""The state from which a run resumes exactly: all its tensors in one safetensors file."""

import json
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor, nn

from mwdn.errors import CheckpointError, reason
from mwdn.io.files import atomic

Header = dict[str, str]
"""Strings stored in the file beside the tensors."""


def write_state(
    path: Path, header: Header, *, network: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer
) -> None:
    """Write weights, their moving average and the optimiser's moments, atomically.

    Raises:
        OSError: as for `mwdn.io.files.atomic`.
        SafetensorError: the file cannot be written.
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
    """Tensors and header of a file, from its bytes.

    Raises:
        CheckpointError: the file is damaged.
    """
    length = int.from_bytes(content[:8], "little")  # of the JSON header that follows
    try:
        return load(content), json.loads(content[8 : 8 + length]).get("__metadata__", {})
    except (SafetensorError, ValueError, KeyError, RecursionError) as error:
        raise damaged(path, reason(error)) from error


def damaged(path: Path, why: str) -> CheckpointError:
    """The error for a state that cannot be used."""
    return CheckpointError(f"`{path}` is damaged: {why}. Remove it to start again.")


def restore(
    state: dict[str, Tensor], *, network: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer
) -> None:
    """Load the tensors of `write_state` into a network, its average and its optimiser."""
    for prefix, module in (("network.", network), ("average.", average)):
        module.load_state_dict({key.removeprefix(prefix): v for key, v in state.items() if key.startswith(prefix)})
    for name, parameter in network.named_parameters():
        if f"optimiser.{name}.step" not in state:
            continue  # a parameter without a gradient
        moments = {key: state[f"optimiser.{name}.{key}"].to(parameter.device) for key in ("exp_avg", "exp_avg_sq")}
        # Adam keeps its moments in the memory format of the weights.
        memory_format = torch.channels_last if parameter.ndim == 4 else torch.contiguous_format
        moments = {key: value.contiguous(memory_format=memory_format) for key, value in moments.items()}
        optimiser.state[parameter] = {"step": state[f"optimiser.{name}.step"].cpu(), **moments}
