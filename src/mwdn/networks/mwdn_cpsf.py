"""Multi Wiener deconvolution network on corrected PSF (section 3.2.2, fig. 2 of the paper)."""

import torch
from torch import Tensor, nn

from mwdn.fourier.padding import Boundary
from mwdn.networks.blocks import Decoder, Encoder, Pooling, Wiener, one_each_colour, paper_widths
from mwdn.types import Measurement, Psf, Scene


class MwdnCpsf(nn.Module):
    """MWDN with a second encoder, which turns the PSF into one corrected PSF for each feature channel.

    21,956,743 learnable numbers at the paper's width: the U-Net's, those of a second encoder of four scales, and
    lambda_1..4. No w: the second encoder sets the energy of each PSF.

    Args:
        channels: colours of the measurement and of the PSF.
        outputs: colours of the scene; as many unless given.
        width: feature channels at full resolution.
        pooling: between the scales of both encoders; the authors' code averages.
        regularisation: start value of lambda (the value of the authors' code).
        boundary: see `mwdn.fourier.padding.Boundary`. The paper writes linear convolutions; its code is circular.
        authors_scalars: also keep what the authors' code has and the paper has not: a learned weight of the PSF
            before its encoder, and a fifth lambda that nothing uses. 21,956,745 learnable numbers.
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        outputs: int | None = None,
        width: int = 64,
        pooling: Pooling = "max",
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
        authors_scalars: bool = False,
    ) -> None:
        super().__init__()
        widths = paper_widths(width)
        self.encoder = Encoder(channels, widths, pooling=pooling)
        self.psf_encoder = Encoder(channels, widths[:-1], pooling=pooling)
        self.filters = nn.ModuleList(
            Wiener(weight=None, regularisation=regularisation, boundary=boundary) for _ in widths[:-1]
        )
        self.decoder = Decoder(outputs or channels, widths)
        if authors_scalars:
            self.weight = nn.Parameter(torch.tensor([1e-3]))
            self.unused_regularisation = nn.Parameter(torch.tensor(regularisation))

    def pyramid(self, psf: Psf) -> list[Tensor]:
        """One corrected PSF for each feature channel at scales 1, 1/2, 1/4, 1/8."""
        return self.psf_encoder(self.weight * psf if hasattr(self, "weight") else psf)

    def forward(self, measurement: Measurement, psf: Psf) -> Scene:
        """Scene (B, outputs, H, W) from a measurement and a PSF of the same height, width and colours."""
        return self.reconstruct(measurement, self.bind(psf, measurement))

    def bind(self, psf: Psf, measurement: Measurement) -> list[Tensor]:
        """What each scale's filter needs of the PSF: all that the network does."""
        psfs = self.pyramid(one_each_colour(psf, measurement))
        return [wiener.known(psfs.pop(0)) for wiener in self.filters]  # type: ignore[operator]

    def reconstruct(self, measurement: Measurement, bound: list[Tensor]) -> Scene:
        """The same as `forward`, from what `bind` gave."""
        features = self.encoder(measurement)
        for scale, (wiener, known) in enumerate(zip(self.filters, bound, strict=True)):
            features[scale] = wiener.filtered(features[scale], known)  # type: ignore[operator]
        return self.decoder(features)
