"""Networks as after training, and empty files."""

from pathlib import Path

import torch
from torch import nn


def trained(network: nn.Module, generator: torch.Generator, *, spread: float = 0.0, power: float = 1.0) -> nn.Module:
    """Evaluation mode, BatchNorm's moments as after training: means of 0 and variances of 1 would hide mistakes.

    Args:
        spread: standard deviation of what is added to the logarithms of learned constants (names with ``log_``).
        power: mean of the variances, which lie within 50 % of it.
    """
    with torch.no_grad():
        if spread:
            for key, parameter in network.named_parameters():
                if "log_" in key:
                    parameter.add_(spread * torch.randn(parameter.shape, generator=generator))
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.running_mean.copy_(0.1 * torch.randn(module.num_features, generator=generator))
                module.running_var.copy_(power * (0.5 + torch.rand(module.num_features, generator=generator)))
    return network.eval()


def touch(folder: Path, *names: str) -> list[Path]:
    """Empty files of these names in a folder, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in names]
    for path in paths:
        path.touch()
    return paths
