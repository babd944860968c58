"""Multi Wiener deconvolution network on corrected PSF (section 3.2.2, fig. 2 of the paper)."""

import math

import torch
from torch import Tensor, nn

from mwdn.fourier.padding import Boundary
from mwdn.networks.blocks import Decoder, Encoder, Pooling, check_sides, paper_widths
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import WienerFilter, WienerFilters, normalise_psf
from mwdn.types import Measurement, Psf, Scene, Size


class MwdnCpsf(Network[list[Tensor]]):
    """MWDN with a second encoder that computes a corrected PSF for each feature channel.

    21,956,743 learnable parameters at the paper's width: the U-Net's, the second encoder's of four scales, and
    lambda_1..4. There is no w: the second encoder sets the energy of each PSF.

    Args:
        channels: colours of the measurement and of the PSF.
        width: feature channels at full resolution.
        pooling: of both encoders; max in the paper, average in the authors' code.
        regularisation: initial value of lambda (the value of the authors' code).
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.
            The paper writes linear convolutions; its code is circular.
        authors_scalars: add two scalars of the authors' code that are not in the paper: a learned weight of the PSF
            before its encoder, and an unused fifth lambda. 21,956,745 learnable parameters.
        authors_form: the authors' form of w and lambda, see `mwdn.networks.Mwdn`.
        orthonormal: divide each corrected PSF by the square root of its number of pixels N, as an orthonormal Fourier
            transform would. Ours, not the paper's. BatchNorm gives corrected PSFs values of about 1 at every pixel, so
            that ``|H|^2`` is about N: lambda is negligible beside it, noise is inverted at all frequencies, and the
            deconvolved features are smaller than others by sqrt(N), 80 times at 80 x 80, so that the decoder hardly
            sees them. Divided, ``|H|^2`` is about 1 at any size, and so is the gain. It is the paper's network with
            lambda N times as large and features sqrt(N) times as large.
    """

    def __init__(  # noqa: PLR0913
        self,
        *,
        channels: int = 3,
        width: int = 64,
        pooling: Pooling = "max",
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
        authors_scalars: bool = False,
        authors_form: bool = False,
        orthonormal: bool = False,
    ) -> None:
        super().__init__()
        self.channels, self.stored_psf, self.orthonormal = channels, authors_form, orthonormal
        widths = paper_widths(width)
        self.encoder = Encoder(channels, widths, pooling=pooling)
        self.psf_encoder = Encoder(channels, widths[:-1], pooling=pooling)
        self.filters = WienerFilters(
            WienerFilter(weight=None, regularisation=regularisation, boundary=boundary, linear=authors_form)
            for _ in widths[:-1]
        )
        self.decoder = Decoder(channels, widths)
        if authors_scalars:
            self.weight = nn.Parameter(torch.tensor([1e-3]))
            self.unused_regularisation = nn.Parameter(torch.tensor(regularisation))

    def pyramid(self, psf: Psf) -> list[Tensor]:
        """Corrected PSFs, one per feature channel, at scales 1, 1/2, 1/4, 1/8."""
        psfs = self.psf_encoder(self.weight * psf if hasattr(self, "weight") else psf)
        if self.orthonormal:
            psfs = [_orthonormal(psfs.pop(0)) for _ in self.filters]  # each is freed once it is divided
        return psfs

    def prepare(self, psf: Psf, size: Size) -> list[Tensor]:
        """Transfer functions of each scale's filter, one per feature channel."""
        check_sides(psf, len(self.filters))
        return self.filters.prepare(self.pyramid(normalise_psf(psf, size, self.channels, stored=self.stored_psf)))

    def reconstruct(self, measurement: Measurement, prepared: list[Tensor]) -> Scene:
        """Scene (B, C, H, W)."""
        return self.decoder(self.filters.deconvolve(self.encoder(measurement), prepared))


def _orthonormal(psf: Tensor) -> Tensor:
    """A PSF over the square root of its number of pixels: the mean of ``|H|^2`` is its mean square (Parseval)."""
    return psf / math.sqrt(psf.shape[-2] * psf.shape[-1])
