"""Multi Wiener deconvolution network (section 3.2.1, fig. 1 of the paper)."""

from torch import Tensor, nn

from mwdn.fourier.padding import Boundary
from mwdn.networks.blocks import Decoder, Encoder, Pooling, Wiener, halve, one_each_colour, paper_widths
from mwdn.types import Measurement, Psf, Scene


class Mwdn(nn.Module):
    """A U-Net whose four skip connections each pass a Wiener filter at their own scale.

    17,267,531 learnable numbers at the paper's width: the U-Net's, w_1..4 and lambda_1..4. The bottleneck is not
    deconvolved. The paper does not say how a PSF of three colours meets 64 feature channels; as in the authors'
    code, its colours are summed and all channels share the sum.

    Args:
        channels: colours of the measurement.
        outputs: colours of the scene; as many unless given.
        width: feature channels at full resolution.
        pooling: between the encoder's scales; the authors' code averages.
        psf_pooling: between the PSF's scales; the paper takes the maximum, the authors' code averages.
        weight: start value of w, for a PSF whose peak is 1 (the value of the authors' code).
        regularisation: start value of lambda (the value of the authors' code).
        boundary: see `mwdn.fourier.padding.Boundary`. The paper writes linear convolutions; its code is circular.
    """

    def __init__(  # noqa: PLR0913
        self,
        *,
        channels: int = 3,
        outputs: int | None = None,
        width: int = 64,
        pooling: Pooling = "max",
        psf_pooling: Pooling = "max",
        weight: float = 1e-3,
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
    ) -> None:
        super().__init__()
        widths = paper_widths(width)
        self.encoder = Encoder(channels, widths, pooling=pooling)
        self.filters = nn.ModuleList(
            Wiener(weight=weight, regularisation=regularisation, boundary=boundary) for _ in widths[:-1]
        )
        self.pool_psf = halve(psf_pooling)
        self.decoder = Decoder(outputs or channels, widths)

    def pyramid(self, psf: Psf) -> list[Tensor]:
        """The PSF, colours summed, at scales 1, 1/2, 1/4, 1/8."""
        psfs = [psf.sum(dim=1, keepdim=True)]
        while len(psfs) < len(self.filters):
            psfs.append(self.pool_psf(psfs[-1]))
        return psfs

    def forward(self, measurement: Measurement, psf: Psf) -> Scene:
        """Scene (B, outputs, H, W) from a measurement and a PSF of the same height and width."""
        return self.reconstruct(measurement, self.bind(psf, measurement))

    def bind(self, psf: Psf, measurement: Measurement) -> list[Tensor]:
        """What each scale's filter needs of the PSF: all that the network does."""
        psfs = self.pyramid(one_each_colour(psf, measurement))
        return [wiener.known(h) for wiener, h in zip(self.filters, psfs, strict=True)]  # type: ignore[operator]

    def reconstruct(self, measurement: Measurement, bound: list[Tensor]) -> Scene:
        """The same as `forward`, from what `bind` gave."""
        features = self.encoder(measurement)
        for scale, (wiener, known) in enumerate(zip(self.filters, bound, strict=True)):
            features[scale] = wiener.filtered(features[scale], known)  # type: ignore[operator]
        return self.decoder(features)
