"""After IFIN: two streams, of the sensor and of the scene, that exchange through the camera's model at every scale."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.fourier.convolution import convolve
from mwdn.fourier.padding import Boundary
from mwdn.fourier.wiener import wiener
from mwdn.networks.blocks import (
    Decoder,
    Encoder,
    Wiener,
    check_channels,
    convolutions,
    paper_widths,
    peak_one_in_colour,
)
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size


class Exchange(nn.Module):
    """One scale: each stream is encoded, then told what the other one says of it.

    Args:
        inputs: channels of each stream at the scale before.
        width: channels at this scale.
        regularisation: start value of the Wiener filter's lambda, one a channel.
        boundary: see `mwdn.fourier.padding.Boundary`.
    """

    def __init__(self, inputs: int, width: int, *, regularisation: float, boundary: Boundary) -> None:
        super().__init__()
        self.boundary = boundary
        self.sensor = convolutions(inputs, width, width, norm="group")
        self.scene = convolutions(inputs, width, width, norm="group")
        self.from_scene = nn.Conv2d(2 * width, width, 1)
        self.from_sensor = nn.Conv2d(2 * width, width, 1)
        self.log_regularisation = nn.Parameter(torch.full((width, 1, 1), math.log(regularisation)))

    def forward(self, sensor: Tensor, scene: Tensor, kernels: Tensor) -> tuple[Tensor, Tensor]:
        """Both streams (B, width, H, W), from those of the scale before and one kernel a channel."""
        sensor, scene = self.sensor(sensor), self.scene(scene)
        cast = convolve(scene, kernels)
        seen = wiener(sensor, kernels, self.log_regularisation.exp(), boundary=self.boundary)
        return (
            sensor + self.from_scene(torch.cat([sensor, cast], dim=1)),
            scene + self.from_sensor(torch.cat([scene, seen], dim=1)),
        )


class IfinPsfs(NamedTuple):
    """The measured PSF at unit sum, and the kernels of each scale, one a channel."""

    measured: Tensor
    kernels: list[Tensor]


class Ifin(Network[IfinPsfs]):
    """IFIN-like: forward and inverse operators interleaved at each of four scales, with kernels adapted to the camera.

    From the source's abstract: differentiable forward operators and learned inverse modules at every stage, which share
    what the measurement's domain and the scene's domain know; a physics-guided adaptation of the PSF. From the facts
    that are known of the better methods: the border is continued before a Wiener step; GroupNorm.

    Inferred, which is all else, so this is *like* IFIN and its figures are not IFIN's: a stream of the measurement and
    one of its Wiener estimate, double convolutions and max-pooling; at each scale the scene stream convolved with the
    kernels joins the measurement's, and the latter deconvolved joins the scene's, by 1x1 convolutions; both meet at the
    bottleneck; the decoder takes the scene stream. Kernels: the measured PSF, averaged to each scale, plus what a
    second encoder sees in it, not negative, of unit sum, one a channel; they begin near the measured PSF.
    7,608,456 learnable numbers at width 32; a count that no source gives.

    Args:
        channels: colours of the measurement and the PSF.
        width: feature channels at full resolution.
        regularisation: start value of every lambda.
        boundary: what stands beyond the measurement in Wiener filters, see `mwdn.fourier.padding.Boundary`.

    References:
        Integrated forward-inverse network, openreview.net/forum?id=q1TpQ6guwX (ECCV 2026).
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        width: int = 32,
        regularisation: float = 1e-2,
        boundary: Boundary = "replicate",
    ) -> None:
        super().__init__()
        self.channels = channels
        *widths, last = paper_widths(width)
        self.first = Wiener(weight=None, regularisation=regularisation, boundary=boundary)
        self.psf_encoder = Encoder(channels, tuple(widths), norm="group")
        # How much of what the encoder sees is added to the PSF, whose peak is 1 at each scale.
        self.log_gain = nn.Parameter(torch.full((len(widths),), math.log(0.01)))
        self.scales = nn.ModuleList(
            Exchange(inputs, own, regularisation=regularisation, boundary=boundary)
            for inputs, own in zip((channels, *widths), widths, strict=False)
        )
        self.bottleneck = convolutions(2 * widths[-1], last, last, norm="group")
        self.decoder = Decoder(channels, (*widths, last), norm="group")

    def kernels(self, psf: Tensor) -> list[Tensor]:
        """One PSF of unit sum for each channel at scales 1, 1/2, 1/4, 1/8, from one of peak 1."""
        result, grey = [], psf.mean(1, keepdim=True)
        for gain, features in zip(self.log_gain.exp(), self.psf_encoder(psf), strict=True):
            kernels = grey / grey.amax((-2, -1), keepdim=True) + gain * features.float()
            result.append(kernels / kernels.sum((-2, -1), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny))
            grey = F.avg_pool2d(grey, 2)
        return result

    def prepare(self, psf: Psf, size: Size) -> IfinPsfs:
        """The PSF for the first Wiener filter, and the kernels of each scale."""
        psf = peak_one_in_colour(psf, size, self.channels)
        return IfinPsfs(psf / psf.sum((-2, -1), keepdim=True), self.kernels(psf))

    def reconstruct(self, measurement: Measurement, prepared: IfinPsfs) -> Scene:
        """Scene (B, C, H, W)."""
        check_channels(measurement, self.channels)
        sensor, scene = measurement, self.first(measurement, prepared.measured)
        skips: list[Tensor] = []
        for scale, kernels in zip(self.scales, prepared.kernels, strict=True):
            if skips:
                sensor, scene = F.max_pool2d(sensor, 2), F.max_pool2d(scene, 2)
            sensor, scene = scale(sensor, scene, kernels)
            skips.append(scene)
        both = torch.cat([F.max_pool2d(sensor, 2), F.max_pool2d(scene, 2)], dim=1)
        return self.decoder([*skips, self.bottleneck(both)])
