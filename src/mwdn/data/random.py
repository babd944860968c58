"""Random numbers of samples: each sample has a generator of its own."""

import torch
from torch import Tensor


def seeded(number: int) -> torch.Generator:
    """A generator for each number, of which torch looks at the lower 32 bits alone."""
    return torch.Generator().manual_seed(number & (2**63 - 1))


def uniform(generators: list[torch.Generator], low: float, high: float, count: int = 1) -> Tensor:
    """(B, count) numbers, each row from its own generator."""
    return torch.stack([torch.rand(count, generator=g) for g in generators]) * (high - low) + low
