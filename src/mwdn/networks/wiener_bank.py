"""A bank of Wiener estimates in front of a U-Net; not from the paper."""

import math

import torch
from torch import nn

from mwdn.errors import ParameterError
from mwdn.fourier import Boundary, wiener
from mwdn.networks.blocks import Decoder, Encoder, Pooling, paper_widths, peak_one
from mwdn.types import Measurement, Psf, Scene


class WienerBank(nn.Module):
    """Several Wiener filters, from strong to weak regularisation, in picture space; a U-Net picks from their estimates.

    A strong lambda leaves a smooth picture of right brightness, a weak one keeps detail and amplifies noise; no single
    one serves all frequencies. Everything is measured in units of the smoothest estimate's brightest pixel and scaled
    back at the end, so exposure and gain cannot matter: the network of a scaled measurement is the scaled scene.

    Args:
        channels: colours of the measurement and the scene.
        width: feature channels at full resolution.
        regularisations: start values of lambda, for a PSF of unit sum, the strongest first.
        pooling: between the encoder's scales.
        boundary: see `mwdn.fourier.Boundary`.
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        width: int = 24,
        regularisations: tuple[float, ...] = (3e-2, 3e-3, 5e-4, 7e-5, 1e-5),
        pooling: Pooling = "max",
        boundary: Boundary = "taper",
    ) -> None:
        super().__init__()
        if not regularisations or min(regularisations) <= 0:
            raise ParameterError(f"`regularisations` {tuple(regularisations)} must be one or more positive numbers.")
        self.channels, self.boundary = channels, boundary
        self.log_regularisations = nn.Parameter(torch.tensor([math.log(value) for value in regularisations]))
        self.encoder = Encoder(channels * (len(regularisations) + 1), paper_widths(width), pooling=pooling)
        self.decoder = Decoder(channels, paper_widths(width))

    def forward(self, measurement: Measurement, psf: Psf) -> Scene:
        """Scene (B, C, H, W), each colour deconvolved with its own PSF."""
        psf = peak_one(psf, measurement)
        psf = psf / psf.sum((-2, -1), keepdim=True)
        lambdas = self.log_regularisations.exp()
        estimates = [wiener(measurement, psf, value, boundary=self.boundary) for value in lambdas]
        unit = estimates[0].detach().amax((1, 2, 3), keepdim=True).clamp(min=1e-6)
        features = self.encoder(torch.cat([*estimates, measurement], dim=1) / unit)
        return unit * self.decoder(features)
