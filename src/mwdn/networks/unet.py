"""The plain U-Net (section 3.2.3 of the paper): no physics."""

from torch import nn

from mwdn.networks.blocks import Decoder, Encoder, Pooling, paper_widths
from mwdn.types import Measurement, Psf, Scene


class UNet(nn.Module):
    """Measurement to scene directly. 17,267,523 learnable numbers at the paper's width.

    Args:
        channels: colours of the measurement.
        outputs: colours of the scene; as many unless given.
        width: feature channels at full resolution; the cost grows with its square.
        pooling: between the encoder's scales; the authors' code averages.
    """

    def __init__(
        self, *, channels: int = 3, outputs: int | None = None, width: int = 64, pooling: Pooling = "max"
    ) -> None:
        super().__init__()
        self.encoder = Encoder(channels, paper_widths(width), pooling=pooling)
        self.decoder = Decoder(outputs or channels, paper_widths(width))

    def forward(self, measurement: Measurement, psf: Psf) -> Scene:
        """Scene (B, outputs, H, W). The PSF is not used: all networks are called alike."""
        return self.decoder(self.encoder(measurement))
