"""Fusion of convolution, BatchNorm and ReLU into one operation, in half precision where that is fast."""

import math
from functools import cache
from typing import Any, TypeGuard

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.inference.tiling import StripDecoder, StripEncoder
from mwdn.networks.blocks import Decoder, Encoder

MIN_HALF_CHANNELS = 16
"""Convolutions with fewer input or output channels work on the picture itself and stay float32, at little cost. In
eight bits a bright measurement would lose the faint contrast that the Wiener filters amplify (up to 20 dB PSNR), and
the reconstruction its finest steps of brightness (1 to 5 dB)."""

MAX_LAYOUTS = 4
"""Shapes of features for which a convolution keeps packed weights: a picture in strips has three."""


class FusedConvolution(nn.Module):
    """Convolution, BatchNorm and ReLU in one operation.

    Args:
        convolution: stride 1, one group.
        norm: BatchNorm after the convolution, or ``None``.
        relu: whether a ReLU follows.
        dtype: precision; ``None`` for float32, which is always used below `MIN_HALF_CHANNELS` channels.
        pack: store the weights in the layout of this CPU's oneDNN, if possible.

    The best layout depends on the features' shape and the number of threads. In another one oneDNN converts the weights
    at each call, which takes up to four times as long as the convolution (256 to 128 channels of 20 x 20, one thread).
    """

    def __init__(
        self,
        convolution: nn.Conv2d,
        norm: nn.BatchNorm2d | None,
        *,
        relu: bool,
        dtype: torch.dtype | None,
        pack: bool = True,
    ) -> None:
        super().__init__()
        weight = convolution.weight.detach().double()
        bias = torch.zeros_like(weight[:, 0, 0, 0]) if convolution.bias is None else convolution.bias.detach().double()
        if norm is not None:
            # (conv - mean) scale + shift is a convolution with scaled weights and another bias.
            mean, variance = norm.state_dict()["running_mean"].double(), norm.state_dict()["running_var"].double()
            scale = norm.weight.double() / (variance + norm.eps).sqrt()
            weight, bias = weight * scale[:, None, None, None], (bias - mean) * scale + norm.bias
        channels = min(convolution.in_channels, convolution.out_channels)
        self.dtype = torch.float32 if dtype is None or channels < MIN_HALF_CHANNELS else dtype
        self.relu, self.padding = relu, [int(p) for p in convolution.padding]
        self.weight = weight.to(self.dtype).contiguous(memory_format=torch.channels_last)
        self.bias = bias.to(self.dtype)
        self.packs = pack and self._can_be_packed()
        self.packed: dict[tuple[int, ...], Tensor] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Without the packed weights, which fit this machine only."""
        return {**vars(self), "packed": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self.packs = self.packs and self._can_be_packed()

    def _can_be_packed(self) -> bool:
        return self.weight.device.type == "cpu" and _can_pack(self.dtype, self.weight.shape[-2:], tuple(self.padding))

    def forward(self, features: Tensor) -> Tensor:
        """Features in channels-last layout and the precision of the weights."""
        features = features.to(self.dtype).contiguous(memory_format=torch.channels_last)
        if not self.packs:
            result = F.conv2d(features, self.weight, self.bias, padding=self.padding)
            return result.relu_() if self.relu else result
        activation = "relu" if self.relu else "none"
        convolve = torch.ops.mkldnn._convolution_pointwise
        weight = self._packed_for(features)
        return convolve(features, weight, self.bias, self.padding, [1, 1], [1, 1], 1, activation, [], "")

    def _packed_for(self, features: Tensor) -> Tensor:
        """The weights in the layout for features of this shape."""
        key = (*features.shape, torch.get_num_threads())
        packed = self.packed.get(key)
        if packed is None:
            if len(self.packed) >= MAX_LAYOUTS:
                self.packed.clear()
            packed = self.packed[key] = _pack(self.weight, self.padding, list(features.shape))
        return packed


class Float32Layer(nn.Module):
    """An unchanged layer that converts its input, possibly in half precision, to float32."""

    def __init__(self, layer: nn.Module) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, features: Tensor, **options: Any) -> Tensor:  # noqa: ANN401
        """Features in float32."""
        return self.layer(features.float(), **options)


def _pack(weight: Tensor, padding: list[int], shape: list[int]) -> Tensor:
    """Weights in oneDNN's layout for features of a shape."""
    return torch._C._nn.mkldnn_reorder_conv2d_weight(weight.to_mkldnn(), padding, [1, 1], [1, 1], 1, shape)  # type: ignore[call-arg]


@cache
def _can_pack(dtype: torch.dtype, kernel: tuple[int, int], padding: tuple[int, ...]) -> bool:
    """Whether this torch has the fused operation for packed weights on the CPU.

    Both functions belong to torch's compiler and are not public, so a small convolution is checked first.
    """
    if not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return False
    features = torch.linspace(-1, 1, 16 * 8 * 8, dtype=dtype).reshape(1, 16, 8, 8)
    weight = torch.linspace(-1, 1, 16 * 16 * math.prod(kernel), dtype=dtype).reshape(16, 16, *kernel)
    features, weight = (t.contiguous(memory_format=torch.channels_last) for t in (features, weight))
    try:
        packed = _pack(weight, list(padding), list(features.shape))
        convolve = torch.ops.mkldnn._convolution_pointwise
        result = convolve(features, packed, weight.new_zeros(16), list(padding), [1, 1], [1, 1], 1, "relu", [], "")
    except (AttributeError, RuntimeError, TypeError):
        return False
    expected = F.conv2d(features.float(), weight.float(), padding=padding).relu()
    return torch.allclose(result.float(), expected, rtol=0.05, atol=0.05 * expected.max().item())


def fuse(module: nn.Module, dtype: torch.dtype | None, *, pack: bool = True) -> nn.Module:
    """Replace each convolution and the BatchNorm and ReLU after it by one `FusedConvolution`, in place.

    Encoders and decoders that consist of such convolutions only then work in strips.

    Args:
        module: in evaluation mode.
        dtype: see `FusedConvolution`.
        pack: see `FusedConvolution`.
    """
    if isinstance(module, nn.Sequential):
        return nn.Sequential(*_fuse_layers(list(module), dtype, pack=pack))
    for name, child in module.named_children():
        setattr(module, name, fuse(child, dtype, pack=pack))
    if isinstance(module, Encoder | Decoder) and all(
        isinstance(layer, FusedConvolution) for scale in module.scales for layer in scale.children()
    ):
        return StripEncoder(module) if isinstance(module, Encoder) else StripDecoder(module)
    if _can_fuse(module):
        return FusedConvolution(module, None, relu=False, dtype=dtype, pack=pack)
    # torch's GroupNorm takes features in bfloat16, but not in float16, with weights in float32.
    unchanged = (nn.Conv2d, nn.ConvTranspose2d, nn.Linear, *([nn.GroupNorm] if dtype is torch.float16 else []))
    return Float32Layer(module) if isinstance(module, unchanged) else module


def _fuse_layers(layers: list[nn.Module], dtype: torch.dtype | None, *, pack: bool) -> list[nn.Module]:
    result: list[nn.Module] = []
    while layers:
        layer = layers.pop(0)
        if not _can_fuse(layer):
            result.append(fuse(layer, dtype, pack=pack))
            continue
        norm = layers[0] if layers and isinstance(layers[0], nn.BatchNorm2d) else None
        layers = layers[norm is not None :]
        relu = bool(layers) and isinstance(layers[0], nn.ReLU)
        layers = layers[relu:]
        result.append(FusedConvolution(layer, norm, relu=relu, dtype=dtype, pack=pack))
    return result


def _can_fuse(layer: nn.Module) -> TypeGuard[nn.Conv2d]:
    """Whether the layer is a convolution that `FusedConvolution` supports."""
    return (
        isinstance(layer, nn.Conv2d)
        and (layer.stride, layer.dilation, layer.groups) == ((1, 1), (1, 1), 1)
        and layer.padding_mode == "zeros"
        and not isinstance(layer.padding, str)
    )
