"""DRUNet: a denoiser for a given noise level, trained without any camera."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.fourier.memory_format import pixel_unshuffle
from mwdn.types import Image


def convolution(inputs: int, outputs: int, size: int) -> nn.Conv2d:
    """Convolution without bias, so that scaling picture and noise scales the result."""
    return nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)


class ResidualBlock(nn.Module):
    """Two convolutions with a skip connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first, last = (convolution(channels, channels, 3) for _ in range(2))
        self.layers = nn.Sequential(first, nn.ReLU(inplace=True), last)
        with torch.no_grad():
            last.weight.mul_(0.3)  # start near the identity

    def forward(self, features: Tensor) -> Tensor:
        """Features of the same shape."""
        return features + self.layers(features)


def _scale(width: int, blocks: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualBlock(width) for _ in range(blocks)))


@checked
class Drunet(nn.Module):
    """U-Net of residual blocks whose input is a picture and a map of its noise level. 1,793,920 learnable parameters.

    Different from DRUNet: a quarter to a half of its widths; pixel-unshuffled input of 2 x 2 blocks, as in FFDNet.
    Strided and transposed convolutions are written as 1x1 convolutions with pixel (un)shuffling, which is equivalent.

    Args:
        channels: colours of the picture.
        widths: feature channels at each scale, finest first; the reference has 64, 128, 256, 512.
        blocks: residual blocks at each scale of encoder and decoder; the reference has 4.
        fold: block size of the pixel unshuffling at the input.
        conditions: numbers that the network is told, each as a constant map: the noise level, and others in its unit.

    References:
        K. Zhang et al., "Plug-and-play image restoration with deep denoiser prior", TPAMI 44 (2022); K. Zhang et al.,
        "FFDNet: toward a fast and flexible solution for CNN-based image denoising", TIP 27 (2018).
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        widths: tuple[int, ...] = (32, 64, 96, 128),
        blocks: int = 2,
        fold: int = 2,
        conditions: int = 1,
    ) -> None:
        super().__init__()
        self.channels, self.fold = channels, fold
        self.head = convolution((channels + conditions) * fold**2, widths[0], 3)
        *left, self.centre = (_scale(width, blocks) for width in widths)
        self.encoder = nn.ModuleList(left)
        self.decoder = nn.ModuleList(_scale(width, blocks) for width in widths[:-1])
        self.down = nn.ModuleList(convolution(4 * fine, coarse, 1) for fine, coarse in pairwise(widths))
        self.up = nn.ModuleList(convolution(coarse, 4 * fine, 1) for fine, coarse in pairwise(widths))
        self.tail = convolution(widths[0], channels * fold**2, 3)
        with torch.no_grad():
            self.tail.weight.mul_(0.1)

    def forward(self, picture: Image, level: Tensor) -> Image:
        """Denoised picture (B, C, H, W).

        Args:
            picture: brightest pixel about 1.
            level: standard deviation of the noise, (1 or B, 1, 1, 1); (1 or B, ``conditions``, 1, 1) if there are more.
        """
        height, width = picture.shape[-2:]
        step = self.fold * 2 ** len(self.down)
        x = torch.cat([picture, level.to(picture).expand(picture.shape[0], -1, height, width)], dim=1)
        x = F.pad(x, (0, -width % step, 0, -height % step), mode="replicate")
        x, skips = self.head(pixel_unshuffle(x, self.fold)), []
        for scale, down in zip(self.encoder, self.down, strict=True):
            skips.append(scale(x))
            x = down(F.pixel_unshuffle(skips[-1], 2))
        x = self.centre(x)
        for scale, up in zip(reversed(self.decoder), reversed(self.up), strict=True):
            x = scale(F.pixel_shuffle(up(x), 2) + skips.pop())
        return picture + F.pixel_shuffle(self.tail(x), self.fold)[..., :height, :width].to(picture)
