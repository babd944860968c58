"""One Wiener filter, then a U-Net (section 3.2.3 of the paper)."""

from torch import Tensor, nn

from mwdn.fourier.padding import Boundary
from mwdn.networks.blocks import Pooling
from mwdn.networks.unet import UNet
from mwdn.networks.wiener import WienerNetwork
from mwdn.types import Measurement, Psf, Scene


class WienerUNet(nn.Module):
    """Deconvolve, then denoise. 17,267,525 learnable numbers at the paper's width.

    Args:
        channels: colours of the measurement.
        outputs: colours of the scene; as many unless given.
        width: feature channels of the U-Net at full resolution.
        pooling: between the encoder's scales; the authors' code averages.
        weight: start value of w.
        regularisation: start value of lambda.
        boundary: see `mwdn.fourier.padding.Boundary`.
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        outputs: int | None = None,
        width: int = 64,
        pooling: Pooling = "max",
        weight: float = 1e-3,
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
    ) -> None:
        super().__init__()
        self.wiener = WienerNetwork(weight=weight, regularisation=regularisation, boundary=boundary)
        self.unet = UNet(channels=channels, outputs=outputs, width=width, pooling=pooling)

    def forward(self, measurement: Measurement, psf: Psf) -> Scene:
        """Scene (B, outputs, H, W)."""
        return self.unet(self.wiener(measurement, psf), psf)

    def bind(self, psf: Psf, measurement: Measurement) -> list[Tensor]:
        """Transfer function of the filter: all that the network needs of the PSF."""
        return self.wiener.bind(psf, measurement)

    def reconstruct(self, measurement: Measurement, bound: list[Tensor]) -> Scene:
        """The same as `forward`, from what `bind` gave."""
        return self.unet.decoder(self.unet.encoder(self.wiener.reconstruct(measurement, bound)))
