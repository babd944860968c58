"""Convolution, BatchNorm and ReLU fused into one operation, in half precision where that is fast."""

from typing import Any, TypeGuard

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.inference.tiling import StripDecoder, StripEncoder
from mwdn.networks.blocks import Decoder, Encoder

FEW = 16
"""A convolution from or to fewer channels sees the picture itself and stays float32: it costs little. In eight bits a
bright measurement would lose the faint contrast that the Wiener filters amplify (up to 20 dB PSNR), and the
reconstruction its finest steps of brightness (1 to 5 dB)."""


class Convolution(nn.Module):
    """A convolution, what is left of the BatchNorm after it, and its ReLU, in one pass.

    Args:
        convolution: of stride 1, not grouped.
        norm: the BatchNorm after it, if there is one.
        relu: whether a ReLU comes last.
        dtype: to compute in; ``None`` for float32, in which `FEW` channels are always.
    """

    def __init__(
        self, convolution: nn.Conv2d, norm: nn.BatchNorm2d | None, *, relu: bool, dtype: torch.dtype | None
    ) -> None:
        super().__init__()
        weight = convolution.weight.detach().double()
        bias = torch.zeros_like(weight[:, 0, 0, 0]) if convolution.bias is None else convolution.bias.detach().double()
        if norm is not None:
            # y = (conv - mean) scale + shift is a convolution with other numbers.
            mean, variance = norm.state_dict()["running_mean"].double(), norm.state_dict()["running_var"].double()
            scale = norm.weight.double() / (variance + norm.eps).sqrt()
            weight, bias = weight * scale[:, None, None, None], (bias - mean) * scale + norm.bias
        few = min(convolution.in_channels, convolution.out_channels) < FEW
        self.dtype = torch.float32 if dtype is None or few else dtype
        self.relu, self.padding = relu, [int(p) for p in convolution.padding]
        self.weight = weight.to(self.dtype).contiguous(memory_format=torch.channels_last)
        self.bias = bias.to(self.dtype)
        self.packed = _packed(self.weight, self.padding)

    def forward(self, features: Tensor) -> Tensor:
        """Features, channels-last, in the precision of the weights."""
        features = features.to(self.dtype).contiguous(memory_format=torch.channels_last)
        if self.packed is None:
            result = F.conv2d(features, self.weight, self.bias, padding=self.padding)
            return result.relu_() if self.relu else result
        last = "relu" if self.relu else "none"
        fused = torch.ops.mkldnn._convolution_pointwise
        return fused(features, self.packed, self.bias, self.padding, [1, 1], [1, 1], 1, last, [], "")


class Float32(nn.Module):
    """A layer that is left as it is, after others that compute in half precision."""

    def __init__(self, layer: nn.Module) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, features: Tensor, **options: Any) -> Tensor:  # noqa: ANN401
        """Features, in float32."""
        return self.layer(features.float(), **options)


def _packed(weight: Tensor, padding: list[int]) -> Tensor | None:
    """Weights in the order that oneDNN reads, where torch has it and can fuse the ReLU; else ``None``.

    Both are what torch's own compiler uses, but no public interface: any other form of them is left alone.
    """
    if weight.device.type != "cpu" or not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return None
    try:
        packed = torch._C._nn.mkldnn_reorder_conv2d_weight(weight.to_mkldnn(), padding, [1, 1], [1, 1], 1)
        probe = weight.new_ones((1, weight.shape[1], 4, 4)).contiguous(memory_format=torch.channels_last)
        bias = torch.zeros_like(weight[:, 0, 0, 0])
        fused = torch.ops.mkldnn._convolution_pointwise
        found = fused(probe, packed, bias, padding, [1, 1], [1, 1], 1, "relu", [], "").float()
    except (AttributeError, RuntimeError, TypeError):
        return None
    expected = F.conv2d(probe.float(), weight.float(), padding=padding).relu()
    return packed if torch.allclose(found, expected, rtol=0.05, atol=0.05 * expected.max().item()) else None


def fuse(module: nn.Module, dtype: torch.dtype | None) -> nn.Module:
    """Replace each convolution, with the BatchNorm and the ReLU right after it, by one `Convolution`; in place.

    The U-Nets that are then nothing else work in strips.
    """
    if isinstance(module, nn.Sequential):
        return nn.Sequential(*_fused(list(module), dtype))
    for name, child in module.named_children():
        setattr(module, name, fuse(child, dtype))
    if isinstance(module, Encoder | Decoder) and all(
        isinstance(layer, Convolution) for scale in module.scales for layer in scale.children()
    ):
        return StripEncoder(module) if isinstance(module, Encoder) else StripDecoder(module)
    if _plain(module):
        return Convolution(module, None, relu=False, dtype=dtype)
    return Float32(module) if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear) else module


def _fused(layers: list[nn.Module], dtype: torch.dtype | None) -> list[nn.Module]:
    result: list[nn.Module] = []
    while layers:
        layer = layers.pop(0)
        if not _plain(layer):
            result.append(fuse(layer, dtype))
            continue
        norm = layers[0] if layers and isinstance(layers[0], nn.BatchNorm2d) else None
        layers = layers[norm is not None :]
        relu = bool(layers) and isinstance(layers[0], nn.ReLU)
        layers = layers[relu:]
        result.append(Convolution(layer, norm, relu=relu, dtype=dtype))
    return result


def _plain(layer: nn.Module) -> TypeGuard[nn.Conv2d]:
    """Whether it is a convolution of the kind that `Convolution` knows."""
    return (
        isinstance(layer, nn.Conv2d)
        and (layer.stride, layer.dilation, layer.groups) == ((1, 1), (1, 1), 1)
        and layer.padding_mode == "zeros"
        and not isinstance(layer.padding, str)
    )
