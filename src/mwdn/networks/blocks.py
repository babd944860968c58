"""Shared blocks: double convolution, U-Net encoder and decoder, learned Wiener filter, PSF normalisation."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.arguments import check_batch
from mwdn.errors import ParameterError, ShapeError
from mwdn.fourier.filtering import filter_image
from mwdn.fourier.memory_format import chunked
from mwdn.fourier.padding import Boundary
from mwdn.fourier.wiener import deconvolution_grid, wiener_transfer
from mwdn.networks.activation_checkpointing import CheckpointedModule
from mwdn.optics.psf import checked_psf
from mwdn.types import Image, Psf, Size

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
            convolutions(inputs, width, width, norm=norm)
            for inputs, width in zip((channels, *widths), widths, strict=False)
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


class WienerFilter(nn.Module):
    """Wiener filter, eq. (2), with a learned weight w and regularisation lambda.

    Both are stored as logarithms, so that they stay positive during training.

    Args:
        weight: initial value of w; ``None`` leaves w out (MWDN-CPSF, whose PSF is learned).
        regularisation: initial value of lambda.
        boundary: see `mwdn.fourier.padding.Boundary`.
        linear: learn w and lambda themselves, as the authors' code does. w may then be or become negative, and training
            moves both by about the learning rate a step, whatever their size.

    Attributes:
        max_grid_pixels: transfer functions with more grid pixels than this, over all channels, are not stored but
            computed when needed. The default is 2^27 complex numbers of half spectra, 1 GB; MWDN-CPSF exceeds it at
            1080 x 1920.
    """

    max_grid_pixels = 2**28
    log_weight: nn.Parameter
    linear_weight: nn.Parameter
    log_regularisation: nn.Parameter
    linear_regularisation: nn.Parameter

    def __init__(
        self,
        *,
        weight: float | None = 1e-3,
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
        linear: bool = False,
    ) -> None:
        super().__init__()
        self.boundary, self.linear, self.has_weight = boundary, linear, weight is not None
        for name, value in (("regularisation", regularisation), ("weight", weight)):
            if value is None:
                continue
            if not value > 0 and not (linear and name == "weight"):
                why = "a filter with a negative lambda has poles" if linear else "its logarithm is learned"
                raise ParameterError(f"`{name}` ({value}) must be positive: {why}.")
            # The names tell `mwdn.training.schedule.make_optimiser` which numbers are logarithms.
            learned = torch.tensor(float(value) if linear else math.log(value))
            setattr(self, f"linear_{name}" if linear else f"log_{name}", nn.Parameter(learned))

    @property
    def weight(self) -> Tensor | None:
        """w, a scalar; ``None`` without one."""
        if not self.has_weight:
            return None
        return self.linear_weight if self.linear else self.log_weight.exp()

    @property
    def regularisation(self) -> Tensor:
        """lambda, a scalar."""
        return self.linear_regularisation if self.linear else self.log_regularisation.exp()

    def forward(self, features: Tensor, psf: Psf) -> Tensor:
        """Deconvolve features (B, C, H, W) with a PSF of 1 or C channels."""
        return self.deconvolve(features, self.prepare(psf))

    def prepare(self, psf: Psf) -> Tensor:
        """Transfer function of the filter; the PSF itself where that would exceed `max_grid_pixels`."""
        grid = self.grid(psf)
        if psf[:, :, 0, 0].numel() * grid[0] * grid[1] > self.max_grid_pixels:
            return psf.contiguous()
        step = self._channels_per_chunk(grid)
        parts = [self.transfer(psf[:, i : i + step]) for i in range(0, psf.shape[1], step)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)

    def transfer(self, psf: Psf) -> Tensor:
        """``w conj(H) / (|w H|^2 + lambda)`` on the grid for features of the PSF's size."""
        if self.weight is not None:
            psf = self.weight * psf
        return wiener_transfer(psf, self.regularisation, self.grid(psf))

    def deconvolve(self, features: Tensor, prepared: Tensor) -> Tensor:
        """Deconvolve features with the result of `prepare`."""
        grid = self.grid(features)
        if prepared.is_complex():
            return filter_image(features, prepared, grid, self.boundary)

        def deconvolve_chunk(features: Tensor, psf: Tensor) -> Tensor:
            return filter_image(features, self.transfer(psf), grid, self.boundary)

        return chunked(deconvolve_chunk, features, prepared, self._channels_per_chunk(grid))

    def grid(self, image: Tensor) -> Size:
        """Size of the Fourier transforms for features or a PSF of this size."""
        return deconvolution_grid((image.shape[-2], image.shape[-1]), self.boundary)

    def _channels_per_chunk(self, grid: Size) -> int:
        """Channels whose transfer functions are computed at once: intermediate arrays take ten times their memory."""
        return max(1, self.max_grid_pixels // (32 * grid[0] * grid[1]))


class WienerFilters(nn.ModuleList):
    """One Wiener filter for each scale, finest first."""

    def __iter__(self) -> Iterator[WienerFilter]:
        return cast(Iterator[WienerFilter], super().__iter__())


def normalise_psf(psf: Psf, size: Size, channels: int | None = None, *, stored: bool = False) -> Tensor:
    """Scale each channel to unit sum, then each PSF to a peak of 1, as the paper's PSFs have.

    Args:
        psf: (1 or B, 1 or C, H, W), of any scale.
        size: height and width of the measurement.
        channels: number of channels to which a grey PSF is expanded; ``None`` keeps it grey.
        stored: leave the scale as it is, for a network with ``stored_psf``.

    Raises:
        ShapeError: the PSF does not have the height and width of the measurement.
    """
    check_size(psf, size)
    if not stored:
        psf = unit_psf(psf)
        psf = psf / psf.amax(dim=(1, 2, 3), keepdim=True)
    return psf if channels is None or psf.shape[1] != 1 else psf.expand(-1, channels, -1, -1)


def unit_psf(psf: Psf) -> Tensor:
    """Scale each channel to unit sum. An exported `prepare` takes such PSFs only, and has no operation for it."""
    return psf if torch.compiler.is_exporting() else checked_psf(psf, values=False)


def check_size(psf: Psf, size: Size) -> None:
    """Raise a `ShapeError` unless the PSF has the height and width of the measurement."""
    check_batch(psf, "psf")
    if tuple(psf.shape[-2:]) != tuple(size):
        raise ShapeError(
            f"`psf` ({psf.shape[-2]} x {psf.shape[-1]}) and `measurement` ({size[0]} x {size[1]}) must have the same "
            "height and width. Bin or crop the PSF: `bin`, `crop`."
        )


def pad_to_minimum(picture: Tensor, side: int) -> Tensor:
    """Pad height and width to at least ``side`` by repeating the last row and column."""
    height, width = picture.shape[-2:]
    return F.pad(picture, (0, max(0, side - width), 0, max(0, side - height)), mode="replicate")


def resize(image: Tensor, size: Size) -> Tensor:
    """Resample an image, such as learned corrections of a PSF, to another size (bilinear, anti-aliased)."""
    if tuple(image.shape[-2:]) == tuple(size):
        return image
    return F.interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)
