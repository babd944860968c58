"""Denoising U-Net of Le-ADMM-U and MMCN."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import check_channels, convolutions
from mwdn.types import Image

WIDTHS = (24, 64, 128, 256, 512)
"""Feature channels at scales 1 to 1/16; the bottleneck, at 1/32, also has 512."""

MINIMUM_SIDE = 64
"""Minimum height and width of a picture: BatchNorm needs more than one value at scale 1/32."""


def scaled_widths(width: int) -> tuple[int, ...]:
    """`WIDTHS` scaled to ``width`` channels at scale 1."""
    return tuple(max(1, round(channels * width / WIDTHS[0])) for channels in WIDTHS)


class DenoisingUNet(nn.Module):
    """U-Net of five scales and a bottleneck. 11,772,307 learnable parameters.

    Each scale of the encoder has two 3x3 convolutions without bias, each with BatchNorm and ReLU, then max-pooling. The
    bottleneck has one. Each scale of the decoder upsamples bilinearly, concatenates the skip connection and has three.
    The 1x1 head has a bias.

    Args:
        channels: of the picture and of the result.
        width: feature channels at full resolution.
        bottleneck_channels: of additional features concatenated at the bottleneck.
    """

    def __init__(self, channels: int, *, width: int = WIDTHS[0], bottleneck_channels: int = 0) -> None:
        super().__init__()
        self.channels = channels
        widths = scaled_widths(width)
        self.encoders = nn.ModuleList(
            convolutions(before, after, after, bias=False) for before, after in pairwise((channels, *widths))
        )
        self.centre = convolutions(widths[-1] + bottleneck_channels, widths[-1], bias=False)
        # 512 + 512 -> 256, 256 + 256 -> 128, ..., 24 + 24 -> 24.
        outputs = (*widths[-2::-1], widths[0])
        self.decoders = nn.ModuleList(
            convolutions(2 * before, after, after, after, bias=False)
            for before, after in zip(widths[::-1], outputs, strict=True)
        )
        self.head = nn.Conv2d(widths[0], channels, 1)

    def forward(self, picture: Image, bottleneck_features: Tensor | None = None) -> Image:
        """Denoised picture; height and width must be at least `MINIMUM_SIDE`."""
        check_channels(picture, self.channels)
        skips, x = [], picture
        for encoder in self.encoders:
            skips.append(encoder(x))
            x = F.max_pool2d(skips[-1], 2)
        x = self.centre(x if bottleneck_features is None else torch.cat([x, bottleneck_features], dim=1))
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = F.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=False)
            x = decoder(torch.cat([x, skip], dim=1))
        return self.head(x)
