"""Multi Wiener deconvolution network (section 3.2.1, fig. 1 of the paper)."""

from torch import Tensor

from mwdn.fourier.padding import Boundary
from mwdn.networks.blocks import Decoder, Encoder, Pooling, check_sides, paper_widths, pooling_layer
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import WienerFilter, WienerFilters, normalise_psf
from mwdn.types import Measurement, Psf, Scene, Size


class Mwdn(Network[list[Tensor]]):
    """A U-Net whose four skip connections each pass through a Wiener filter at their own scale.

    17,267,531 learnable parameters at the paper's width: the U-Net's, w_1..4 and lambda_1..4. The bottleneck is not
    deconvolved. The paper does not say how a PSF of three colours applies to 64 feature channels; as in the
    authors' code, its colours are summed and all channels share the sum.

    Args:
        channels: colours of the measurement.
        width: feature channels at full resolution.
        pooling: between the encoder's scales; the authors' code averages.
        psf_pooling: between the PSF's scales; the paper takes the maximum, the authors' code averages.
        weight: initial value of w, for a PSF whose peak is 1 (the value of the authors' code).
        regularisation: initial value of lambda (the value of the authors' code).
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.
            The paper writes linear convolutions; its code is circular.
        authors_form: learn w and lambda as the authors' code does, themselves instead of their logarithms, so that w
            may become negative; and take the PSF as stored (`mwdn.networks.Network.stored_psf`). For exact comparison,
            together with both poolings "average" and the boundary "circular".
    """

    def __init__(  # noqa: PLR0913
        self,
        *,
        channels: int = 3,
        width: int = 64,
        pooling: Pooling = "max",
        psf_pooling: Pooling = "max",
        weight: float = 1e-3,
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
        authors_form: bool = False,
    ) -> None:
        super().__init__()
        self.channels, self.stored_psf = channels, authors_form
        widths = paper_widths(width)
        self.encoder = Encoder(channels, widths, pooling=pooling)
        self.filters = WienerFilters(
            WienerFilter(weight=weight, regularisation=regularisation, boundary=boundary, linear=authors_form)
            for _ in widths[:-1]
        )
        self.pool_psf = pooling_layer(psf_pooling)
        self.decoder = Decoder(channels, widths)

    def pyramid(self, psf: Psf) -> list[Tensor]:
        """The PSF, colours summed, at scales 1, 1/2, 1/4, 1/8."""
        psfs = [psf.sum(dim=1, keepdim=True)]
        while len(psfs) < len(self.filters):
            psfs.append(self.pool_psf(psfs[-1]))
        return psfs

    def prepare(self, psf: Psf, size: Size) -> list[Tensor]:
        """Transfer function of each scale's filter."""
        check_sides(psf, len(self.filters))
        return self.filters.prepare(self.pyramid(normalise_psf(psf, size, self.channels, stored=self.stored_psf)))

    def reconstruct(self, measurement: Measurement, prepared: list[Tensor]) -> Scene:
        """Scene (B, C, H, W)."""
        return self.decoder(self.filters.deconvolve(self.encoder(measurement), prepared))
