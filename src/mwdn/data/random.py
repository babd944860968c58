"""Random numbers for samples: each sample has its own generator."""

import torch
from torch import Tensor


def seeded(number: int) -> torch.Generator:
    """A generator seeded with the number, of which torch uses the lower 32 bits only."""
    return torch.Generator().manual_seed(number & (2**63 - 1))


def uniform(generators: list[torch.Generator], low: float, high: float, count: int = 1) -> Tensor:
    """(B, count) uniform random numbers, each row from its own generator."""
    return torch.stack([torch.rand(count, generator=g) for g in generators]) * (high - low) + low
