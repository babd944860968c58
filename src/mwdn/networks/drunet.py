"""A network that takes noise of a known level out of a picture: what scenes look like, without any camera."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.fourier.memory_format import pixel_unshuffle
from mwdn.types import Image


def convolution(inputs: int, outputs: int, size: int) -> nn.Conv2d:
    """Without a bias, as everywhere here: brighter light and noise give a brighter result."""
    return nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)


class Residual(nn.Module):
    """Two convolutions whose result is added to what they see."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first, last = (convolution(channels, channels, 3) for _ in range(2))
        self.layers = nn.Sequential(first, nn.ReLU(inplace=True), last)
        with torch.no_grad():
            last.weight.mul_(0.3)  # begin near the identity

    def forward(self, features: Tensor) -> Tensor:
        """Features of the same shape."""
        return features + self.layers(features)


def _scale(width: int, blocks: int) -> nn.Sequential:
    return nn.Sequential(*(Residual(width) for _ in range(blocks)))


class Drunet(nn.Module):
    """DRUNet at a quarter of its widths, on 2 x 2 pixels at once as in FFDNet: 1,793,920 learnable numbers.

    A U-Net of residual blocks that sees the picture and a plane of the noise level. Halving and doubling, in the
    reference convolutions of stride 2, are convolutions of 1 x 1 pixels between folded ones: the same maps.

    Args:
        channels: colours of the picture.
        widths: feature channels at each scale, finest first; the reference has 64, 128, 256, 512.
        blocks: residual blocks of each scale on either side; the reference has 4.
        fold: pixels along each side of those that are one pixel of more channels at the finest scale.

    References:
        K. Zhang et al., "Plug-and-play image restoration with deep denoiser prior", TPAMI 44 (2022); K. Zhang et al.,
        "FFDNet: toward a fast and flexible solution for CNN-based image denoising", TIP 27 (2018).
    """

    def __init__(
        self, *, channels: int = 3, widths: tuple[int, ...] = (32, 64, 96, 128), blocks: int = 2, fold: int = 2
    ) -> None:
        super().__init__()
        self.fold = fold
        self.head = convolution((channels + 1) * fold**2, widths[0], 3)
        *left, self.centre = (_scale(width, blocks) for width in widths)
        self.encoder = nn.ModuleList(left)
        self.decoder = nn.ModuleList(_scale(width, blocks) for width in widths[:-1])
        self.down = nn.ModuleList(convolution(4 * fine, coarse, 1) for fine, coarse in pairwise(widths))
        self.up = nn.ModuleList(convolution(coarse, 4 * fine, 1) for fine, coarse in pairwise(widths))
        self.tail = convolution(widths[0], channels * fold**2, 3)
        with torch.no_grad():
            self.tail.weight.mul_(0.1)

    def forward(self, picture: Image, level: Tensor) -> Image:
        """The picture (B, C, H, W) without its noise.

        Args:
            picture: its brightest pixel is about 1.
            level: standard deviation of its noise, (1 or B, 1, 1, 1).
        """
        height, width = picture.shape[-2:]
        step = self.fold * 2 ** len(self.down)
        x = torch.cat([picture, level.to(picture).expand(picture.shape[0], 1, height, width)], dim=1)
        x = F.pad(x, (0, -width % step, 0, -height % step), mode="replicate")
        x, skips = self.head(pixel_unshuffle(x, self.fold)), []
        for scale, down in zip(self.encoder, self.down, strict=True):
            skips.append(scale(x))
            x = down(F.pixel_unshuffle(skips[-1], 2))
        x = self.centre(x)
        for scale, up in zip(reversed(self.decoder), reversed(self.up), strict=True):
            x = scale(F.pixel_shuffle(up(x), 2) + skips.pop())
        return picture + F.pixel_shuffle(self.tail(x), self.fold)[..., :height, :width].to(picture)
