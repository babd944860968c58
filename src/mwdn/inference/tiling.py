"""U-Nets in strips of rows, to bound the memory that large pictures need.

Each strip is computed with a halo of the convolutions' receptive field, so the result is that of the whole picture up
to the order of additions. Only the input and the result of each scale are stored whole.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import Decoder, Encoder, check_channels, check_sides
from mwdn.types import Size, size_of

Rows = Callable[[int, int], Tensor]
"""Rows ``first`` to ``last`` of a picture, (B, C, last - first, W), as a function of both."""

MAX_STRIP_NUMBERS = 2**25
"""Limit of a strip's widest features: 64 MB in bfloat16. On a GPU the limit is 16 times as large."""


class StripEncoder(nn.Module):
    """An `Encoder` that consists of `mwdn.inference.fusion.FusedConvolution` only."""

    max_strip_numbers = MAX_STRIP_NUMBERS

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.channels, self.pool, self.scales = encoder.channels, encoder.pool, encoder.scales

    def forward(self, picture: Tensor) -> list[Tensor]:
        """Features, finest first."""
        check_channels(picture, self.channels)
        check_sides(picture, len(self.scales) - 1)
        size = size_of(picture)
        limit = self.max_strip_numbers
        features = [apply_in_strips(self.scales[0], size, lambda first, last: picture[..., first:last, :], limit)]
        for scale in self.scales[1:]:
            size = size[0] // 2, size[1] // 2
            finer = features[-1]
            pooled = lambda first, last, finer=finer: self.pool(finer[..., 2 * first : 2 * last, :])  # noqa: E731
            features.append(apply_in_strips(scale, size, pooled, limit))
        return features


class StripDecoder(nn.Module):
    """A `Decoder` that consists of `mwdn.inference.fusion.FusedConvolution` only. Its last scale includes the head."""

    max_strip_numbers = MAX_STRIP_NUMBERS

    def __init__(self, decoder: Decoder) -> None:
        super().__init__()
        *coarse, finest = decoder.scales
        self.scales = nn.ModuleList([*coarse, nn.Sequential(*finest, decoder.head)])  # type: ignore[misc]

    def forward(self, features: list[Tensor]) -> Tensor:
        """Reconstruction at the finest scale. The list of features is emptied to free memory."""
        x = features.pop()
        for scale in self.scales:
            skip = features.pop()
            size = size_of(skip)

            def joined(first: int, last: int, skip: Tensor = skip, x: Tensor = x, size: Size = size) -> Tensor:
                return torch.cat([skip[..., first:last, :], upsample_rows(x, size, first, last)], dim=1)

            x = apply_in_strips(scale, size, joined, self.max_strip_numbers)
            del skip, joined
        return x


def apply_in_strips(layers: nn.Module, size: Size, rows: Rows, max_numbers: int) -> Tensor:
    """Apply a sequence of convolutions strip by strip.

    Args:
        layers: the convolutions.
        size: height and width of the input.
        rows: the input.
        max_numbers: limit of a strip's widest features on a CPU.
    """
    height, width = size
    convolutions: list[Any] = list(layers.children())
    halo = sum(layer.padding[0] for layer in convolutions)
    widest = max(channels for layer in convolutions for channels in layer.weight.shape[:2])
    limit = 16 * max_numbers if convolutions[0].weight.is_cuda else max_numbers
    step = max(1, limit // (width * widest))
    if step >= height:
        return layers(rows(0, height))
    result = torch.empty(0)
    for first in range(0, height, step):
        last = min(first + step, height)
        start, stop = max(0, first - halo), min(height, last + halo)
        strip = layers(rows(start, stop))[..., first - start : last - start, :]
        if first == 0:
            shape = (*strip.shape[:2], height, width)
            result = torch.empty(shape, dtype=strip.dtype, device=strip.device, memory_format=torch.channels_last)
        result[..., first:last, :] = strip
    return result


def upsample_rows(picture: Tensor, size: Size, first: int, last: int) -> Tensor:
    """Rows ``first`` to ``last`` of ``F.interpolate(picture, size, mode="bilinear", align_corners=True)``."""
    if last - first == size[0]:
        return F.interpolate(picture, size=size, mode="bilinear", align_corners=True)
    height = picture.shape[-2]
    # Positions in float32, as in torch.
    position = torch.arange(first, last, dtype=torch.float32, device=picture.device)
    position = position * (torch.tensor(height - 1.0) / (size[0] - 1)).item()
    above = position.long().clamp(max=height - 1)
    below = (above + 1).clamp(max=height - 1)
    pixels = picture.movedim(1, -1)  # keeps channels-last
    weight = (position - above)[:, None, None]
    rows = torch.lerp(pixels[:, above].float(), pixels[:, below].float(), weight).to(picture.dtype)
    return F.interpolate(rows.movedim(-1, 1), size=(last - first, size[1]), mode="bilinear", align_corners=True)
