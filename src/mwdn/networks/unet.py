"""The plain U-Net (section 3.2.3 of the paper): no physics."""

from mwdn.networks.blocks import Decoder, Encoder, Pooling, paper_widths
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size


class UNet(Network[None]):
    """U-Net from measurement to scene. 17,267,523 learnable parameters at the paper's width.

    Args:
        channels: colours of the measurement.
        width: feature channels at full resolution; the cost grows with its square.
        pooling: between the encoder's scales; the authors' code averages.
    """

    def __init__(self, *, channels: int = 3, width: int = 64, pooling: Pooling = "max") -> None:
        super().__init__()
        self.channels = channels
        self.encoder = Encoder(channels, paper_widths(width), pooling=pooling)
        self.decoder = Decoder(channels, paper_widths(width))

    def prepare(self, psf: Psf, size: Size) -> None:
        """Unused: the network does not depend on the PSF."""

    def reconstruct(self, measurement: Measurement, prepared: None = None) -> Scene:
        """Scene (B, C, H, W)."""
        return self.decoder(self.encoder(measurement))
