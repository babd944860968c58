"""Activation checkpointing for large pictures: features inside a scale are recomputed in the backward pass."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from mwdn.errors import ParameterError


class CheckpointedModule(nn.Module):
    """A module whose scales can be checkpointed one by one.

    Attributes:
        checkpoints_activations: store only the inputs of each scale and recompute its features for the gradient.
    """

    checkpoints_activations = False

    def checkpointed(self, function: Callable[..., Tensor], *inputs: nn.Module | Tensor) -> Tensor:
        """Compute one scale, ``function(*inputs)``."""
        if not (self.checkpoints_activations and torch.is_grad_enabled()):
            return function(*inputs)

        def contexts() -> tuple[AbstractContextManager[None], ...]:
            return nullcontext(), _frozen_statistics(self)  # of the first pass and of its repetition

        # No layer uses random numbers, so their state need not be saved.
        return checkpoint(function, *inputs, use_reentrant=False, preserve_rng_state=False, context_fn=contexts)  # type: ignore[arg-type]


def checkpoint_activations(network: nn.Module) -> None:
    """Turn activation checkpointing on in the network's U-Nets.

    Raises:
        ParameterError: the network has no U-Net of this kind.
    """
    modules = [module for module in network.modules() if isinstance(module, CheckpointedModule)]
    if not modules:
        raise ParameterError(
            f"`checkpointing` needs a network with the paper's U-Net; {type(network).__name__} has none. Leave it out."
        )
    for module in modules:
        module.checkpoints_activations = True


def batch_norms(network: nn.Module) -> list[nn.modules.batchnorm._BatchNorm]:
    """Every BatchNorm layer of a network, synchronised over processes or not."""
    return [module for module in network.modules() if isinstance(module, nn.modules.batchnorm._BatchNorm)]


@contextmanager
def _frozen_statistics(network: nn.Module) -> Iterator[None]:
    """Keep BatchNorm's running statistics: the first pass has already included this batch in them."""
    norms = batch_norms(network)
    settings = [(norm.momentum, norm.num_batches_tracked) for norm in norms]
    try:
        for norm in norms:
            norm.momentum, norm.num_batches_tracked = 0.0, norm.num_batches_tracked.clone()  # type: ignore[union-attr]
        yield
    finally:
        for norm, (momentum, count) in zip(norms, settings, strict=True):
            norm.momentum, norm.num_batches_tracked = momentum, count
