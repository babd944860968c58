"""U-Nets on pictures too large to be in memory many times over: a strip of rows at a time.

A strip is computed from so many rows more above and below as its convolutions see. So the result is that of the whole
picture, but for the order of additions; what is kept whole is each scale's input and result.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import Decoder, Encoder, check_channels
from mwdn.types import Size

Rows = Callable[[int, int], Tensor]
"""(first, last) to these rows of a picture, (B, C, last - first, W)."""


LARGEST = 2**25
"""Numbers that a strip may have where its features are widest: 64 MB in bfloat16. A GPU has room for 16 times that."""


class StripEncoder(nn.Module):
    """An `Encoder` of nothing but `mwdn.inference.fusion.Convolution`."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.channels, self.pool, self.scales = encoder.channels, encoder.pool, encoder.scales

    def forward(self, picture: Tensor) -> list[Tensor]:
        """Features, finest first."""
        check_channels(picture, self.channels)
        size = picture.shape[-2], picture.shape[-1]
        features = [in_strips(self.scales[0], size, lambda first, last: picture[..., first:last, :])]
        for scale in self.scales[1:]:
            size = size[0] // 2, size[1] // 2
            finer = features[-1]
            halved = lambda first, last, finer=finer: self.pool(finer[..., 2 * first : 2 * last, :])  # noqa: E731
            features.append(in_strips(scale, size, halved))
        return features


class StripDecoder(nn.Module):
    """A `Decoder` of nothing but `mwdn.inference.fusion.Convolution`. Its head belongs to its last scale."""

    def __init__(self, decoder: Decoder) -> None:
        super().__init__()
        *coarse, finest = decoder.scales
        self.scales = nn.ModuleList([*coarse, nn.Sequential(*finest, decoder.head)])  # type: ignore[misc]

    def forward(self, features: list[Tensor]) -> Tensor:
        """Picture of the finest feature's size. The list is emptied on the way."""
        x = features.pop()
        for scale in self.scales:
            skip = features.pop()
            size = skip.shape[-2], skip.shape[-1]

            def joined(first: int, last: int, skip: Tensor = skip, x: Tensor = x, size: Size = size) -> Tensor:
                return torch.cat([skip[..., first:last, :], enlarged(x, size, first, last)], dim=1)

            x = in_strips(scale, size, joined)
            del skip, joined
        return x


def in_strips(layers: nn.Module, size: Size, rows: Rows) -> Tensor:
    """What convolutions, one after the other, make of a picture of ``size`` that ``rows`` gives a part of."""
    height, width = size
    each: list[Any] = list(layers.children())
    halo = sum(layer.padding[0] for layer in each)
    widest = max(channels for layer in each for channels in layer.weight.shape[:2])
    largest = 16 * LARGEST if each[0].weight.is_cuda else LARGEST
    step = max(1, largest // (width * widest))
    if step >= height:
        return layers(rows(0, height))
    result = torch.empty(0)
    for first in range(0, height, step):
        last = min(first + step, height)
        start, stop = max(0, first - halo), min(height, last + halo)
        part = layers(rows(start, stop))[..., first - start : last - start, :]
        if first == 0:
            shape = (*part.shape[:2], height, width)
            result = torch.empty(shape, dtype=part.dtype, device=part.device, memory_format=torch.channels_last)
        result[..., first:last, :] = part
    return result


def enlarged(picture: Tensor, size: Size, first: int, last: int) -> Tensor:
    """Rows of ``F.interpolate(picture, size, mode="bilinear", align_corners=True)``."""
    if last - first == size[0]:
        return F.interpolate(picture, size=size, mode="bilinear", align_corners=True)
    height = picture.shape[-2]
    # In float32, as torch computes where it looks.
    position = torch.arange(first, last, dtype=torch.float32, device=picture.device)
    position = position * (torch.tensor(height - 1.0) / (size[0] - 1)).item()
    above = position.long().clamp(max=height - 1)
    below = (above + 1).clamp(max=height - 1)
    pixels = picture.movedim(1, -1)  # channels-last stays so
    weight = (position - above)[:, None, None]
    rows = torch.lerp(pixels[:, above].float(), pixels[:, below].float(), weight).to(picture.dtype)
    return F.interpolate(rows.movedim(-1, 1), size=(last - first, size[1]), mode="bilinear", align_corners=True)
