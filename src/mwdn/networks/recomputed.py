"""Training on large pictures: the features inside a scale are computed again for the gradient instead of being kept."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from mwdn.errors import ParameterError


class Stages(nn.Module):
    """A network that is computed scale by scale.

    Attributes:
        recompute: keep what goes into each scale alone, and compute the rest again for the gradient.
    """

    recompute = False

    def stage(self, function: Callable[..., Tensor], *inputs: nn.Module | Tensor) -> Tensor:
        """One scale, ``function(*inputs)``."""
        if not (self.recompute and torch.is_grad_enabled()):
            return function(*inputs)
        again: Callable[[], tuple[AbstractContextManager[None], ...]] = lambda: (nullcontext(), _seen(self))  # noqa: E731
        # Nothing in a scale draws random numbers.
        return checkpoint(function, *inputs, use_reentrant=False, preserve_rng_state=False, context_fn=again)  # type: ignore[arg-type]


def recompute(network: nn.Module) -> None:
    """Let each scale of a network's U-Nets be computed again for the gradient.

    Raises:
        ParameterError: the network has no scales.
    """
    stages = [module for module in network.modules() if isinstance(module, Stages)]
    if not stages:
        raise ParameterError(
            f"`checkpointing` needs a network with the paper's U-Net, which {type(network).__name__} has not. "
            "Leave it out."
        )
    for module in stages:
        module.recompute = True


def norms(network: nn.Module) -> list[nn.modules.batchnorm._BatchNorm]:
    """Every BatchNorm of a network, of one process or of several."""
    return [module for module in network.modules() if isinstance(module, nn.modules.batchnorm._BatchNorm)]


@contextmanager
def _seen(network: nn.Module) -> Iterator[None]:
    """BatchNorm has counted this batch already: its running statistics stay as they are."""
    found = norms(network)
    before = [(norm.momentum, norm.num_batches_tracked) for norm in found]
    try:
        for norm in found:
            norm.momentum, norm.num_batches_tracked = 0.0, norm.num_batches_tracked.clone()  # type: ignore[union-attr]
        yield
    finally:
        for norm, (momentum, count) in zip(found, before, strict=True):
            norm.momentum, norm.num_batches_tracked = momentum, count
