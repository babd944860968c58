"""One Wiener filter, then a U-Net (section 3.2.3 of the paper)."""

from torch import Tensor

from mwdn.fourier.padding import Boundary
from mwdn.networks.blocks import Pooling
from mwdn.networks.network import Network
from mwdn.networks.unet import UNet
from mwdn.networks.wiener import WienerNetwork
from mwdn.types import Measurement, Psf, Scene, Size


class WienerUNet(Network[Tensor]):
    """Deconvolve, then denoise. 17,267,525 learnable parameters at the paper's width.

    Args:
        channels: colours of the measurement.
        width: feature channels of the U-Net at full resolution.
        pooling: between the encoder's scales; the authors' code averages.
        weight: initial value of w.
        regularisation: initial value of lambda.
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.
        authors_form: the authors' form of w and lambda, see `mwdn.networks.Mwdn`.
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        width: int = 64,
        pooling: Pooling = "max",
        weight: float = 1e-3,
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
        authors_form: bool = False,
    ) -> None:
        super().__init__()
        self.channels, self.stored_psf = channels, authors_form
        self.wiener = WienerNetwork(
            weight=weight, regularisation=regularisation, boundary=boundary, authors_form=authors_form
        )
        self.unet = UNet(channels=channels, width=width, pooling=pooling)

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """Transfer function of the filter."""
        return self.wiener.prepare(psf, size)

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W)."""
        return self.unet.reconstruct(self.wiener.reconstruct(measurement, prepared))
