"""The training loss: a weighted sum of distances between images."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mwdn.errors import ParameterError, UnknownNameError, shown
from mwdn.evaluation.alexnet import load_alexnet, load_heads
from mwdn.evaluation.distances import feature_mse, l1, log_mse, lpips, mse, ssim, vgg_mse
from mwdn.evaluation.vgg import load_vgg16
from mwdn.types import Image

DISTANCES: dict[str, Callable[..., Tensor]] = {
    "feature_mse": feature_mse,
    "l1": l1,
    "log_mse": log_mse,
    "lpips": lpips,
    "mse": mse,
    "ssim": lambda image, reference: 1 - ssim(image, reference),
    "vgg_mse": vgg_mse,
}
LOSS_PARTS = tuple(DISTANCES)
"""Parts of a `Loss`."""
NEED_ALEXNET = {"feature_mse", "lpips"}
"""Parts that compare AlexNet's features."""


class Loss(nn.Module):
    """A weighted sum of distances, averaged over the batch.

    AlexNet, VGG-16 and the linear heads of LPIPS are loaded only if a part needs them; move them with ``.to(device)``.

    Args:
        weights: of each part by its name in `LOSS_PARTS`; the last phase of the MWDN paper's training has
            ``{"mse": 1.0, "feature_mse": 0.05}``. "ssim" is 1 - SSIM. A part of weight 0 is reported, not trained on.
        alexnet: file of AlexNet's weights; see `mwdn.evaluation.alexnet.load_alexnet`.
        heads: file of LPIPS's linear heads; see `mwdn.evaluation.alexnet.load_heads`.

    Raises:
        UnknownNameError: no such part.
        ParameterError: no part, or a weight that is negative or not finite.
        CheckpointError: the weights of a needed network cannot be loaded.
    """

    def __init__(
        self, weights: Mapping[str, float], *, alexnet: str | Path | None = None, heads: str | Path | None = None
    ) -> None:
        super().__init__()
        self.initial_weights = checked_weights(weights)
        self.weights = dict(self.initial_weights)
        """Current weights, which a schedule may replace by others of the same names."""
        self.alexnet = load_alexnet(alexnet) if NEED_ALEXNET & set(weights) else None
        self.vgg = load_vgg16() if "vgg_mse" in weights else None
        self.heads = load_heads(heads, alexnet=alexnet) if "lpips" in weights else None

    def forward(self, reconstruction: Image, scene: Image) -> tuple[Tensor, dict[str, Tensor]]:
        """Compare a batch of reconstructions with their scenes.

        Args:
            reconstruction: (B, C, H, W), nominally in [0, 1].
            scene: of the same shape.

        Returns:
            The weighted sum to be minimised, a scalar; and each part without its weight, scalars without gradient.

        Raises:
            ShapeError: the shapes differ, or a part cannot be computed for them.
        """
        total, parts = reconstruction.new_zeros((), dtype=torch.float32), {}
        for name, weight in self.weights.items():
            with torch.set_grad_enabled(weight > 0 and torch.is_grad_enabled()):
                part = DISTANCES[name](reconstruction, scene, *self._networks(name)).mean()
            total = total + weight * part if weight > 0 else total
            parts[name] = part.detach()
        return total, parts

    def _networks(self, name: str) -> tuple[nn.Module | None, ...]:
        """Networks that a distance takes."""
        own = {"feature_mse": (self.alexnet,), "vgg_mse": (self.vgg,), "lpips": (self.alexnet, self.heads)}
        return own.get(name, ())


def checked_weights(weights: Mapping[str, Any]) -> dict[str, float]:
    """Check the weights of a `Loss`; raises its errors."""
    if not weights:
        raise ParameterError(f"The loss must name at least one of {', '.join(LOSS_PARTS)}, for example `mse = 1.0`.")
    for name, weight in weights.items():
        if name not in LOSS_PARTS:
            raise UnknownNameError("loss", name, LOSS_PARTS)
        if not (isinstance(weight, int | float) and 0 <= weight < 2**63):
            raise ParameterError(f"The weight of `{name}` ({shown(weight)}) must be finite and not negative.")
    if not any(weights.values()):
        raise ParameterError(f"The loss ({', '.join(weights)}) must have a weight above 0, for example `mse = 1.0`.")
    return {name: float(weight) for name, weight in weights.items()}
