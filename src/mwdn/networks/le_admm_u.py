"""Le-ADMM-U: Le-ADMM followed by a denoising U-Net, trained end to end."""

from torch import Tensor

from mwdn.networks.blocks import pad_to_minimum
from mwdn.networks.denoising_unet import MINIMUM_SIDE, DenoisingUNet
from mwdn.networks.le_admm import LeAdmm
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size


class LeAdmmU(Network[Tensor]):
    """`LeAdmm`, then a denoising U-Net. 20 + 11,772,307 = 11,772,327 learnable parameters.

    Different from the source: BatchNorm has torch's epsilon; pictures below 64 pixels are padded for the U-Net.

    Args:
        channels: colours of the measurement.
        width: feature channels of the U-Net at full resolution.
        iterations: number of ADMM iterations.
        threshold: initial value of tau / mu2, see `LeAdmm`.

    References:
        K. Monakhova et al., Learned reconstructions for practical mask-based lensless imaging, Optics Express 27,
        28075 (2019); github.com/Waller-Lab/LenslessLearning.
    """

    def __init__(self, *, channels: int = 3, width: int = 24, iterations: int = 5, threshold: float = 2e-4) -> None:
        super().__init__()
        self.channels = channels
        self.admm = LeAdmm(iterations=iterations, threshold=threshold)
        self.denoiser = DenoisingUNet(channels, width=width)

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """Transfer function of the PSF, see `LeAdmm`."""
        return self.admm.prepare(psf, size)

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W)."""
        height, width = measurement.shape[-2:]
        scene = self.admm.reconstruct(measurement, prepared)
        return self.denoiser(pad_to_minimum(scene, MINIMUM_SIDE))[..., :height, :width]
