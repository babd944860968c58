"""IFIN-like network: sensor and scene features coupled by forward and inverse operators at every scale."""

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.fourier.convolution import convolve
from mwdn.fourier.padding import Boundary
from mwdn.fourier.wiener import wiener
from mwdn.networks.blocks import Decoder, Encoder, check_channels, check_sides, convolutions, paper_widths
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import WienerFilter, normalise_psf
from mwdn.optics.psf import unit_sum
from mwdn.types import Measurement, Psf, Scene, Size


class Exchange(nn.Module):
    """One scale: both streams are encoded, then exchange features through convolution and Wiener filter.

    Args:
        inputs: channels of each stream at the previous scale.
        width: channels at this scale.
        regularisation: initial value of the Wiener filter's lambda, learned for each channel.
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.
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
        """Both streams (B, width, H, W), from those of the previous scale and one kernel per channel."""
        sensor, scene = self.sensor(sensor), self.scene(scene)
        pattern = convolve(scene, kernels)
        estimate = wiener(sensor, kernels, self.log_regularisation.exp(), boundary=self.boundary)
        return (
            sensor + self.from_scene(torch.cat([sensor, pattern], dim=1)),
            scene + self.from_sensor(torch.cat([scene, estimate], dim=1)),
        )


class IfinPsfs(NamedTuple):
    """Transfer function of the first Wiener filter, and the kernels of each scale, one per channel."""

    first: Tensor
    kernels: list[Tensor]


class Ifin(Network[IfinPsfs]):
    """U-Net with forward and inverse operators at each of four scales, and kernels adapted from the measured PSF.

    7,608,456 learnable parameters at width 32. No source gives a count.

    From the source's abstract: differentiable forward operators and learned inverse modules at every stage, which
    exchange features of the measurement and of the scene; physics-guided adaptation of the PSF. From other successful
    methods: padding before a Wiener filter; GroupNorm.

    Inferred, so the results are not IFIN's:

    - two streams, of the measurement and of its Wiener estimate, with double convolutions and max-pooling;
    - at each scale a 1x1 convolution merges the scene features, convolved with the kernels, into the sensor stream, and
      another merges the deconvolved sensor features into the scene stream;
    - the streams are concatenated at the bottleneck; skip connections come from the scene stream;
    - a kernel per channel: the measured PSF, averaged to the scale, plus features of a second encoder, non-negative and
      of unit sum, initially near the measured PSF.

    Args:
        channels: colours of the measurement and the PSF.
        width: feature channels at full resolution.
        regularisation: initial value of every lambda.
        boundary: of the Wiener filters: values beyond the border of what is filtered, see
            `mwdn.fourier.padding.Boundary`.

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
        self.first = WienerFilter(weight=None, regularisation=regularisation, boundary=boundary)
        self.psf_encoder = Encoder(channels, tuple(widths), norm="group")
        # Gain of the encoder's features, which are added to the PSF at a peak of 1.
        self.log_gain = nn.Parameter(torch.full((len(widths),), math.log(0.01)))
        self.scales = nn.ModuleList(
            Exchange(before, after, regularisation=regularisation, boundary=boundary)
            for before, after in pairwise((channels, *widths))
        )
        self.bottleneck = convolutions(2 * widths[-1], last, last, norm="group")
        self.decoder = Decoder(channels, (*widths, last), norm="group")

    def kernels(self, psf: Tensor) -> list[Tensor]:
        """Kernels of unit sum, one per channel, at scales 1, 1/2, 1/4, 1/8, from a PSF of peak 1."""
        result, grey = [], psf.mean(1, keepdim=True)
        for gain, features in zip(self.log_gain.exp(), self.psf_encoder(psf), strict=True):
            kernels = grey / grey.amax((-2, -1), keepdim=True) + gain * features.float()
            result.append(unit_sum(kernels))
            grey = F.avg_pool2d(grey, 2)
        return result

    def prepare(self, psf: Psf, size: Size) -> IfinPsfs:
        """Transfer function of the first Wiener filter, and the kernels of each scale."""
        psf = normalise_psf(psf, size, self.channels)
        check_sides(psf, len(self.scales))
        return IfinPsfs(self.first.prepare(unit_sum(psf)), self.kernels(psf))

    def reconstruct(self, measurement: Measurement, prepared: IfinPsfs) -> Scene:
        """Scene (B, C, H, W)."""
        check_channels(measurement, self.channels)
        sensor, scene = measurement, self.first.deconvolve(measurement, prepared.first)
        skips: list[Tensor] = []
        for scale, kernels in zip(self.scales, prepared.kernels, strict=True):
            if skips:
                sensor, scene = F.max_pool2d(sensor, 2), F.max_pool2d(scene, 2)
            sensor, scene = scale(sensor, scene, kernels)
            skips.append(scene)
        both = torch.cat([F.max_pool2d(sensor, 2), F.max_pool2d(scene, 2)], dim=1)
        return self.decoder([*skips, self.bottleneck(both)])
