"""The U-Net that Le-ADMM-U and MMCN put behind their iterations."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import check_channels, convolutions
from mwdn.types import Image

WIDTHS = (24, 64, 128, 256, 512)
"""Feature channels at scales 1 to 1/16; the centre, at 1/32, has as many as the last."""

SMALLEST = 64
"""Least side of a picture: at 1/32 BatchNorm then still has more than one value."""


def scaled_widths(width: int) -> tuple[int, ...]:
    """`WIDTHS` in proportion, for ``width`` channels at scale 1."""
    return tuple(max(1, round(each * width / WIDTHS[0])) for each in WIDTHS)


class Denoiser(nn.Module):
    """U-Net of five scales and a centre, 11,772,307 learnable numbers: 3x3 convolutions without bias, BatchNorm, ReLU.

    Two convolutions a scale, then max-pooling; one in the centre; after each bilinear up-sampling and joining of the
    skip connection three; a 1x1 head with bias.

    Args:
        channels: of the picture and of the result.
        width: feature channels at full resolution.
        joining: channels of other features of the centre's size that join there.
    """

    def __init__(self, channels: int, *, width: int = WIDTHS[0], joining: int = 0) -> None:
        super().__init__()
        self.channels = channels
        widths = scaled_widths(width)
        self.encoders = nn.ModuleList(
            convolutions(inputs, own, own, bias=False) for inputs, own in zip((channels, *widths), widths, strict=False)
        )
        self.centre = convolutions(widths[-1] + joining, widths[-1], bias=False)
        # 512 + 512 -> 256, 256 + 256 -> 128, ..., 24 + 24 -> 24.
        following = (*widths[-2::-1], widths[0])
        self.decoders = nn.ModuleList(
            convolutions(2 * own, after, after, after, bias=False)
            for own, after in zip(widths[::-1], following, strict=True)
        )
        self.head = nn.Conv2d(widths[0], channels, 1)

    def forward(self, picture: Image, joining: Tensor | None = None) -> Image:
        """Picture of the same size, at least `SMALLEST` along each side."""
        check_channels(picture, self.channels)
        skips, x = [], picture
        for encoder in self.encoders:
            skips.append(encoder(x))
            x = F.max_pool2d(skips[-1], 2)
        x = self.centre(x if joining is None else torch.cat([x, joining], dim=1))
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = F.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=False)
            x = decoder(torch.cat([x, skip], dim=1))
        return self.head(x)
