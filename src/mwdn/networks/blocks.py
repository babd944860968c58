"""Blocks of the U-Nets: double convolution, encoder, decoder; checks and sizes of pictures for all networks."""

import math
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.arguments import check_batch
from mwdn.errors import ParameterError, ShapeError
from mwdn.networks.activation_checkpointing import CheckpointedModule
from mwdn.types import Image, Size

Pooling = Literal["max", "average"]

Normalisation = Literal["batch", "group"]


def pooling_layer(kind: Pooling) -> nn.Module:
    """2 x 2 pooling; an odd last row or column is dropped."""
    return nn.MaxPool2d(2) if kind == "max" else nn.AvgPool2d(2)


def normalisation_layer(kind: Normalisation, channels: int) -> nn.Module:
    """BatchNorm, or GroupNorm of up to 8 groups with 2 or more channels each."""
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    if kind != "group":
        raise ParameterError(f"`norm` must be batch or group, not {kind!r}.")
    return nn.GroupNorm(math.gcd(8, channels // 2) if channels % 2 == 0 else 1, channels)


def convolutions(*widths: int, bias: bool = True, norm: Normalisation = "batch") -> nn.Sequential:
    """A 3x3 convolution, normalisation and ReLU from each of ``widths`` to the next."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1, bias=bias), normalisation_layer(norm, outputs)]
        layers.append(nn.ReLU(inplace=True))
    return nn.Sequential(*layers)


def check_channels(picture: Image, channels: int) -> None:
    """Raise a `ShapeError` unless a measurement or PSF has the network's number of channels."""
    check_batch(picture, "picture")
    if picture.shape[1] != channels:
        raise ShapeError(
            f"A picture or PSF {tuple(picture.shape)} must have {channels} channels for this network. "
            f"Train one with `channels={picture.shape[1]}`, or calibrate with frames of {channels}."
        )


def check_sides(picture: Image, halvings: int) -> None:
    """Raise a `ShapeError` unless a measurement or PSF can be halved ``halvings`` times."""
    if min(picture.shape[-2:]) < 2**halvings:
        raise ShapeError(
            f"A picture or PSF {tuple(picture.shape)} must have at least {2**halvings} x {2**halvings} pixels for this "
            "network. Bin or crop less, or use a solver: `mwdn.solvers.Admm()`."
        )


class Encoder(CheckpointedModule):
    """U-Net encoder: a double convolution at each of the scales 1, 1/2, 1/4, ..., with pooling between them.

    Args:
        channels: of the picture.
        widths: feature channels at each scale, (64, 128, 256, 512, 512) in the paper.
        pooling: max in the paper's figure, average in the authors' code.
        norm: normalisation after each convolution.
    """

    def __init__(
        self, channels: int, widths: tuple[int, ...], *, pooling: Pooling = "max", norm: Normalisation = "batch"
    ) -> None:
        super().__init__()
        self.channels = channels
        self.pool = pooling_layer(pooling)
        self.scales = nn.ModuleList(
            convolutions(inputs, width, width, norm=norm) for inputs, width in pairwise((channels, *widths))
        )

    def forward(self, picture: Image) -> list[Tensor]:
        """Features of each scale, finest first.

        Raises:
            ShapeError: the picture does not have ``channels`` channels, or is too small for all scales.
        """
        check_channels(picture, self.channels)
        check_sides(picture, len(self.scales) - 1)
        features = [self.checkpointed(self.scales[0], picture)]
        for scale in self.scales[1:]:
            features.append(self.checkpointed(self._pool_and_convolve, scale, features[-1]))
        return features

    def _pool_and_convolve(self, scale: nn.Module, features: Tensor) -> Tensor:
        return scale(self.pool(features))


class Decoder(CheckpointedModule):
    """U-Net decoder: at each scale upsample, concatenate the skip connection, double convolution; then a 1x1 head.

    Args:
        channels: of the reconstruction.
        widths: as in the encoder.
        norm: normalisation after each convolution.
    """

    def __init__(self, channels: int, widths: tuple[int, ...], *, norm: Normalisation = "batch") -> None:
        super().__init__()
        first, *skips = widths[::-1]
        # 512 + 512 -> 256, 256 + 256 -> 128, 128 + 128 -> 64, 64 + 64 -> 64.
        outputs = (*skips[1:], skips[-1])
        inputs = [skip + upsampled for skip, upsampled in zip(skips, (first, *outputs), strict=False)]
        self.scales = nn.ModuleList(
            convolutions(before, before // 2, after, norm=norm) for before, after in zip(inputs, outputs, strict=True)
        )
        self.head = nn.Conv2d(outputs[-1], channels, 1)

    def forward(self, features: list[Tensor]) -> Image:
        """Reconstruction at the finest scale, from features ordered finest first.

        The list is emptied to free memory: each feature is needed only once.
        """
        x = features.pop()
        for scale in self.scales:
            x = self.checkpointed(self._upsample_and_convolve, scale, features.pop(), x)
        return self.head(x)

    @staticmethod
    def _upsample_and_convolve(scale: nn.Module, skip: Tensor, x: Tensor) -> Tensor:
        x = F.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=True)
        return scale(torch.cat([skip, x], dim=1))


def paper_widths(width: int) -> tuple[int, ...]:
    """Feature channels of the U-Net at scales 1 to 1/16, for ``width`` at scale 1 (64 in the paper)."""
    return (width, 2 * width, 4 * width, 8 * width, 8 * width)


def pad_to_minimum(picture: Tensor, side: int) -> Tensor:
    """Pad height and width to at least ``side`` by repeating the last row and column."""
    height, width = picture.shape[-2:]
    return F.pad(picture, (0, max(0, side - width), 0, max(0, side - height)), mode="replicate")


def resize(image: Tensor, size: Size) -> Tensor:
    """Resample an image, such as learned corrections of a PSF, to another size (bilinear, anti-aliased)."""
    if tuple(image.shape[-2:]) == tuple(size):
        return image
    return F.interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)
