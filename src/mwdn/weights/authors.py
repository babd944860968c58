"""Load checkpoints of the MWDN authors' public code (github.com/IOE8AILab/MWDNs)."""

from typing import Any

import torch
from torch import Tensor, nn

from mwdn.errors import CheckpointError, ParameterError
from mwdn.networks.empty import build_empty
from mwdn.weights.tensors import check_shapes, fill

AUTHORS_OPTIONS: dict[str, Any] = {"pooling": "average", "boundary": "circular", "authors_form": True}
"""Where their code differs from their paper, for both networks."""

# Their module names and ours. Each scale is a double convolution, which theirs wraps in one more module.
_ENCODER = {"inc": "0", "down1.avgpool_conv.1": "1", "down2.avgpool_conv.1": "2", "down3.avgpool_conv.1": "3"}
_MODULES = {f"{theirs}.double_conv": f"encoder.scales.{ours}" for theirs, ours in _ENCODER.items()}
_MODULES |= {"down4.avgpool_conv.1.double_conv": "encoder.scales.4", "outc.conv": "decoder.head"}
_MODULES |= {f"up{i + 1}.conv.double_conv": f"decoder.scales.{i}" for i in range(4)}
_MODULES |= {
    f"{theirs}.double_conv": f"psf_encoder.scales.{i}"
    for i, theirs in enumerate(("inc0", "down11.avgpool_conv.1", "down22.avgpool_conv.1", "down33.avgpool_conv.1"))
}


def is_authors(state: dict[str, Tensor]) -> bool:
    """Whether the tensors have the authors' names."""
    return {"w", "delta", "inc.double_conv.0.weight", "outc.conv.weight"} <= state.keys()


def load_authors(state: dict[str, Tensor]) -> nn.Module:
    """Build MWDN or MWDN-CPSF as in the authors' code, with their weights.

    These networks take the PSF as stored (`mwdn.networks.Network.stored_psf`), in [0, 1] with its background:
    calibrate with ``background=0``. Their w may be negative, as training with their own settings makes it.

    Args:
        state: tensors under the authors' names.

    Raises:
        CheckpointError: a tensor is missing, unexpected or of another shape, or a lambda is not positive.
    """
    name = "mwdn-cpsf" if "inc0.double_conv.0.weight" in state else "mwdn"
    extra = {"authors_scalars": True} if name == "mwdn-cpsf" else {"psf_pooling": "average"}
    not_dense = [key for key, value in state.items() if not _is_dense(value)]
    if not_dense:
        raise CheckpointError(f"`{not_dense[0][:80]}` must be a plain tensor of numbers. Save it with `contiguous()`.")
    first = state["inc.double_conv.0.weight"]
    scalars = {"w": 1, "delta": 5} if name == "mwdn-cpsf" else {"w": 4, "delta": 4}
    wrong = [key for key, length in scalars.items() if state[key].shape != (length,)]
    if wrong or first.ndim != 4:
        raise CheckpointError(
            f"`{'`, `'.join(wrong) or 'inc.double_conv.0.weight'}` must have the shape of the authors' {name} "
            f"({scalars} numbers). Take a checkpoint of their code."
        )
    ours = renamed(state, name)
    try:
        network = build_empty(name, **AUTHORS_OPTIONS, **extra, channels=first.shape[1], width=first.shape[0])
    except ParameterError as error:
        raise CheckpointError(f"These weights have the names of the authors' {name}, but {error}") from error
    shapes = {key: tuple(value.shape) for key, value in ours.items()}
    check_shapes(network, shapes, f"These weights have the names of the authors' {name}, but not their shapes")
    return fill(network, ours.items(), "The checkpoint")


def _is_dense(tensor: Tensor) -> bool:
    """Whether a real tensor stores all of its elements; with a stride of 0 it could claim any number of them."""
    real = tensor.layout == torch.strided and not tensor.is_quantized and not tensor.is_complex()
    return real and tensor.numel() * tensor.itemsize <= tensor.untyped_storage().nbytes()


def renamed(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Their tensors under our names, for the network ``name``."""
    ours: dict[str, Tensor] = {}
    for key, value in state.items():
        if key in ("w", "delta"):
            continue
        module = next((module for module in _MODULES if key.startswith(module + ".")), None)
        ours[key.replace(module, _MODULES[module], 1) if module else key] = value
    regularisations = state["delta"][:4]
    if not (regularisations > 0).all():
        raise CheckpointError(
            f"`delta` ({regularisations.tolist()}) must be positive: a filter with a negative lambda has poles. Take "
            "another checkpoint of the training."
        )
    for i, regularisation in enumerate(regularisations):
        ours[f"filters.{i}.linear_regularisation"] = regularisation
    if name == "mwdn-cpsf":
        return ours | {"weight": state["w"], "unused_regularisation": state["delta"][4]}
    return ours | {f"filters.{i}.linear_weight": weight for i, weight in enumerate(state["w"])}
