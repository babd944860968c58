"""Load the weights of a network into one with more inputs or outputs."""

import torch
from torch import Tensor, nn


def grown(weights: dict[str, Tensor], network: nn.Module) -> dict[str, Tensor]:
    """Weights for a network that has more inputs or outputs after the existing ones; the new ones are zero.

    If a tensor differs in several axes, as in a wider network, the weights stay unchanged. Missing buffers are those of
    the network.
    """
    result = dict(network.named_buffers()) | weights
    for name, wanted in network.state_dict().items():
        value = weights.get(name)
        if value is None or value.shape == wanted.shape or value.ndim != wanted.ndim:
            continue
        pairs = [(old, new) for old, new in zip(value.shape, wanted.shape, strict=True) if old != new]
        if len(pairs) > 1 or pairs[0][0] > pairs[0][1]:
            return weights
        result[name] = torch.zeros_like(wanted)
        result[name][tuple(slice(length) for length in value.shape)] = value
    return result
