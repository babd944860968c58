"""BatchNorm over a batch that is shared by several processes, and the biases that BatchNorm cancels."""

import itertools
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.runtime import distributed

PSF_ENCODER = "psf_encoder"
"""Name of the submodule that processes only the PSF; every process has its whole batch."""

AXES = (0, 2, 3)
"""All axes but the channels."""


def freeze_cancelled(network: nn.Module) -> None:
    """Freeze each bias in front of a BatchNorm, which subtracts it again.

    Its gradient is 0 except for rounding. Adam normalises gradients and would turn this noise into full steps, which
    differ between machines and numbers of processes.
    """
    for module in network.modules():
        if isinstance(module, nn.Sequential):
            for layer, following in itertools.pairwise(module):
                if isinstance(layer, nn.Conv2d) and layer.bias is not None and isinstance(following, nn.BatchNorm2d):
                    layer.bias.requires_grad_(False)


def synchronise(network: nn.Module, device: torch.device) -> None:
    """Make every BatchNorm normalise over the batch of all processes instead of this process's share.

    The PSF encoder stays as it is: its batch is one PSF, the same on all processes.

    Args:
        network: changed in place; its parameters, and so the checkpoint, stay.
        device: where it computes. GPUs use torch's `SyncBatchNorm`, which does not support the CPU.
    """
    if distributed.world_size() == 1:
        return
    for name, child in network.named_children():
        if name == PSF_ENCODER:
            continue
        if not isinstance(child, nn.BatchNorm2d):
            synchronise(child, device)
        elif device.type == "cuda":
            setattr(network, name, nn.SyncBatchNorm.convert_sync_batchnorm(child))  # type: ignore[no-untyped-call]
        else:
            child.__class__ = GlobalBatchNorm2d


class GlobalBatchNorm2d(nn.BatchNorm2d):
    """BatchNorm over the shares of a batch on all processes, which may have different sizes."""

    def forward(self, input: Tensor) -> Tensor:
        """Normalise (B, C, H, W); in training by the mean and variance over all processes."""
        if not self.training:
            return super().forward(input)
        mean, variance, count = _moments(input)
        with torch.no_grad():
            self.num_batches_tracked.add_(1)  # type: ignore[union-attr]
            for running, new in ((self.running_mean, mean), (self.running_var, variance * count / (count - 1))):
                running.lerp_(new.to(running), self.momentum)  # type: ignore[union-attr, arg-type]
        numbers = (mean, variance, count, self.eps)
        return _Normalise.apply(input, self.weight, self.bias, *numbers)  # type: ignore[no-untyped-call]


@torch.no_grad()
def _moments(features: Tensor) -> tuple[Tensor, Tensor, float]:
    """Mean and variance (C,) over all processes in float64, and the number of values per channel."""
    own_variance, own_mean = torch.var_mean(_precise(features), AXES, correction=0)
    own_count = torch.full_like(own_mean, features.numel() // features.shape[1])
    # Gather by summing: each process fills its row of a table of zeros. Means and variances of the shares are combined
    # exactly; sums of squares would lose digits where the mean is large.
    table = own_mean.new_zeros(distributed.world_size(), 3, len(own_mean), dtype=torch.float64)
    table[distributed.rank()] = torch.stack([own_count, own_mean, own_variance])
    counts, means, variances = distributed.all_reduce_sum(table).unbind(1)
    part = counts / counts.sum(0)
    mean = (part * means).sum(0)
    variance = (part * (variances + (means - mean).square())).sum(0)
    return mean, variance, counts[:, 0].sum().item()


def _precise(features: Tensor) -> Tensor:
    return features.float() if features.dtype == torch.bfloat16 else features


class _Normalise(torch.autograd.Function):
    """y = w z + b with z = (x - m) s and s = 1 / sqrt(v + eps), where m and v depend on the x of all processes.

    With g = dL/dy, the gradient is dL/dx = w s (g - mean(g) - z mean(g z)), with means over all processes;
    dL/dw = sum(g z) and dL/db = sum(g).
    """

    @staticmethod
    def forward(  # noqa: PLR0913
        ctx: Any,  # noqa: ANN401
        x: Tensor,
        w: Tensor,
        b: Tensor,
        m: Tensor,
        v: Tensor,
        count: float,
        eps: float,
    ) -> Tensor:
        ctx.save_for_backward(x, w, m, (v + eps).rsqrt())
        ctx.count = count
        return F.batch_norm(x, m.to(w), v.to(w), w, b, training=False, eps=eps)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        x, w, m, s = ctx.saved_tensors
        g = _precise(gradient)
        w_s, m, s = (value.to(g)[:, None, None] for value in (w * s, m, s))
        z = (_precise(x) - m) * s
        own = torch.stack([g.sum(AXES), (g * z).sum(AXES)])
        mean_g, mean_gz = (distributed.all_reduce_sum(own.to(torch.float64, copy=True)) / ctx.count).to(g)[
            ..., None, None
        ]
        # Gradients of w and b cover this process's share: `distributed.all_reduce_gradients` sums them.
        return (w_s * (g - mean_g - z * mean_gz)).to(x.dtype), own[1].to(w), own[0].to(w), None, None, None, None
