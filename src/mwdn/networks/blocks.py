"""The parts that the paper's networks share: convolution block, encoder, decoder, learned Wiener filter."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.errors import ParameterError, ShapeError
from mwdn.fourier.filtering import filter_image
from mwdn.fourier.memory_format import chunked
from mwdn.fourier.padding import Boundary
from mwdn.fourier.wiener import deconvolution_grid, wiener_transfer
from mwdn.networks.recomputed import Stages
from mwdn.types import Image, Psf, Size

Pooling = Literal["max", "average"]

Normalisation = Literal["batch", "group"]


def halve(kind: Pooling) -> nn.Module:
    """Halve height and width, rounding down."""
    kinds = {"max": nn.MaxPool2d, "average": nn.AvgPool2d}
    if kind not in kinds:
        raise ParameterError(f"`pooling` must be max or average, not {kind!r}.")
    return kinds[kind](2)


def normalisation(kind: Normalisation, channels: int) -> nn.Module:
    """Normalise features over the batch, or over groups of channels of each sample (8 groups, of 2 or more)."""
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    if kind != "group":
        raise ParameterError(f"`norm` must be batch or group, not {kind!r}.")
    return nn.GroupNorm(math.gcd(8, channels // 2) if channels % 2 == 0 else 1, channels)


def convolutions(*widths: int, bias: bool = True, norm: Normalisation = "batch") -> nn.Sequential:
    """(3x3 convolution, normalisation, ReLU) from each of ``widths`` to the next."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1, bias=bias), normalisation(norm, outputs)]
        layers.append(nn.ReLU(inplace=True))
    return nn.Sequential(*layers)


def check_channels(picture: Image, channels: int) -> None:
    """Raise a `ShapeError` unless a measurement or PSF has as many channels as the network."""
    if picture.shape[1] != channels:
        raise ShapeError(
            f"A picture or PSF {tuple(picture.shape)} must have {channels} channels for this network. "
            f"Train one with `channels={picture.shape[1]}`, or calibrate with frames of {channels}."
        )


class Encoder(Stages):
    """Left half of a U-Net: features at scales 1, 1/2, 1/4, ..., each a double convolution of the one before.

    Args:
        channels: of the picture.
        widths: feature channels at each scale, (64, 128, 256, 512, 512) in the paper.
        pooling: between the scales; the paper's figure shows max-pooling, the authors' code averages.
        norm: what follows each convolution.
    """

    def __init__(
        self, channels: int, widths: tuple[int, ...], *, pooling: Pooling = "max", norm: Normalisation = "batch"
    ) -> None:
        super().__init__()
        self.channels = channels
        self.pool = halve(pooling)
        self.scales = nn.ModuleList(
            convolutions(inputs, width, width, norm=norm)
            for inputs, width in zip((channels, *widths), widths, strict=False)
        )

    def forward(self, picture: Image) -> list[Tensor]:
        """Features, finest first.

        Raises:
            ShapeError: the picture has another number of channels.
        """
        check_channels(picture, self.channels)
        features = [self.stage(self.scales[0], picture)]
        for scale in self.scales[1:]:
            features.append(self.stage(self._halved, scale, features[-1]))
        return features

    def _halved(self, scale: nn.Module, features: Tensor) -> Tensor:
        return scale(self.pool(features))


class Decoder(Stages):
    """Right half of a U-Net: up-sample, join the skip connection, double convolution; then a 1x1 head.

    Args:
        channels: of the reconstruction.
        widths: those of the encoder.
        norm: what follows each convolution.
    """

    def __init__(self, channels: int, widths: tuple[int, ...], *, norm: Normalisation = "batch") -> None:
        super().__init__()
        first, *skips = widths[::-1]
        # 512 + 512 -> 256, 256 + 256 -> 128, 128 + 128 -> 64, 64 + 64 -> 64: what comes up has the skip's width.
        following = (*skips[1:], skips[-1])
        joined = [a + b for a, b in zip((first, *following), skips, strict=False)]
        self.scales = nn.ModuleList(
            convolutions(inputs, inputs // 2, outputs, norm=norm)
            for inputs, outputs in zip(joined, following, strict=True)
        )
        self.head = nn.Conv2d(following[-1], channels, 1)

    def forward(self, features: list[Tensor]) -> Image:
        """Picture of the finest feature's size, from features, finest first.

        The list is emptied on the way: each feature is needed once, and of a large picture there is no room to spare.
        """
        x = features.pop()
        for scale in self.scales:
            x = self.stage(self._joined, scale, features.pop(), x)
        return self.head(x)

    @staticmethod
    def _joined(scale: nn.Module, skip: Tensor, x: Tensor) -> Tensor:
        x = F.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=True)
        return scale(torch.cat([skip, x], dim=1))


def paper_widths(width: int) -> tuple[int, ...]:
    """Feature channels of the U-Net at scales 1 to 1/16, for ``width`` at scale 1 (64 in the paper)."""
    return (width, 2 * width, 4 * width, 8 * width, 8 * width)


LARGEST = 2**28
"""Grid pixels, over all channels, up to which transfer functions are kept: half spectra of 2^27 complex numbers, 1 GB.

MWDN-CPSF has more at 1080 x 1920."""


class Wiener(nn.Module):
    """A Wiener filter, eq. (2), whose weight w and regularisation lambda are learned.

    Both are stored as logarithms, so that no gradient step can make them negative.

    Args:
        weight: start value of w; ``None`` leaves w out (MWDN-CPSF, whose PSF is learned).
        regularisation: start value of lambda.
        boundary: see `mwdn.fourier.padding.Boundary`.
    """

    def __init__(
        self, *, weight: float | None = 1e-3, regularisation: float = 1e-2, boundary: Boundary = "taper"
    ) -> None:
        super().__init__()
        for name, value in (("weight", weight), ("regularisation", regularisation)):
            if value is not None and not value > 0:
                raise ParameterError(f"`{name}` ({value}) must be positive: its logarithm is what is learned.")
        self.log_regularisation = nn.Parameter(torch.tensor(math.log(regularisation)))
        if weight is not None:
            self.log_weight = nn.Parameter(torch.tensor(math.log(weight)))
        self.boundary = boundary

    def forward(self, features: Tensor, psf: Psf) -> Tensor:
        """Deconvolve each channel with the PSF, or with its own PSF where there is one for each channel."""
        return self.deconvolve(features, self.prepare(psf))

    def prepare(self, psf: Psf) -> Tensor:
        """Transfer function of the filter; the PSF itself where the transfer function would exceed `LARGEST`."""
        grid = self.grid(psf)
        if psf[:, :, 0, 0].numel() * grid[0] * grid[1] > LARGEST:
            return psf.contiguous()
        step = _channels_per_chunk(grid)
        parts = [self.transfer(psf[:, i : i + step]) for i in range(0, psf.shape[1], step)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)

    def transfer(self, psf: Psf) -> Tensor:
        """``w conj(H) / (|w H|^2 + lambda)`` on the grid for features of the PSF's size."""
        if hasattr(self, "log_weight"):
            psf = self.log_weight.exp() * psf
        return wiener_transfer(psf, self.log_regularisation.exp(), self.grid(psf))

    def deconvolve(self, features: Tensor, prepared: Tensor) -> Tensor:
        """The same as `forward`, from the result of `prepare`."""
        grid = self.grid(features)
        if prepared.is_complex():
            return filter_image(features, prepared, grid, self.boundary)

        def deconvolve_few(features: Tensor, psf: Tensor) -> Tensor:
            return filter_image(features, self.transfer(psf), grid, self.boundary)

        return chunked(deconvolve_few, features, prepared, _channels_per_chunk(grid))

    def grid(self, image: Tensor) -> Size:
        """Grid of the Fourier transforms for features or a PSF of this size."""
        return deconvolution_grid((image.shape[-2], image.shape[-1]), self.boundary)


class WienerFilters(nn.ModuleList):
    """Wiener filters, one a scale, finest first."""

    def __iter__(self) -> Iterator[Wiener]:
        return cast(Iterator[Wiener], super().__iter__())


def _channels_per_chunk(grid: Size) -> int:
    """Channels whose transfer functions are computed at once: the intermediate arrays take ten times their memory."""
    return max(1, LARGEST // (32 * grid[0] * grid[1]))


def peak_one(psf: Psf, size: Size) -> Psf:
    """Scale each PSF so that its largest value is 1, the range that the paper's PSFs have.

    Raises:
        ShapeError: the PSF does not have the height and width of the measurement.
    """
    check_size(psf, size)
    return psf / psf.amax(dim=(1, 2, 3), keepdim=True)


def peak_one_in_colour(psf: Psf, size: Size, channels: int) -> Tensor:
    """`peak_one`, and a grey PSF repeated for each colour: all colours then cast the same pattern."""
    psf = peak_one(psf, size)
    return psf.expand(-1, channels, -1, -1) if psf.shape[1] == 1 else psf


def check_size(psf: Psf, size: Size) -> None:
    """Raise a `ShapeError` unless the PSF has the height and width of the measurement."""
    if tuple(psf.shape[-2:]) != tuple(size):
        raise ShapeError(
            f"`psf` ({psf.shape[-2]} x {psf.shape[-1]}) and `measurement` ({size[0]} x {size[1]}) must have the same "
            "height and width. Bin or crop the PSF: `--bin`, `--crop`."
        )


def at_least(picture: Tensor, side: int) -> Tensor:
    """Continue a picture smaller than ``side`` to that height or width, by its last row or column."""
    height, width = picture.shape[-2:]
    return F.pad(picture, (0, max(0, side - width), 0, max(0, side - height)), mode="replicate")


def resized(image: Tensor, size: Size) -> Tensor:
    """The image at another size: what was learned at one serves at another, as a binned PSF does a binned capture."""
    if tuple(image.shape[-2:]) == tuple(size):
        return image
    return F.interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)
