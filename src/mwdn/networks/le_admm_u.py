"""Learned ADMM followed by a U-Net, trained together."""

from torch import Tensor

from mwdn.networks.blocks import at_least
from mwdn.networks.denoiser import SMALLEST, Denoiser
from mwdn.networks.le_admm import LeAdmm
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size


class LeAdmmU(Network[Tensor]):
    """`LeAdmm`, then a U-Net that denoises what it leaves: 20 + 11,772,307 = 11,772,327 learnable numbers.

    All from the source but: BatchNorm's epsilon is torch's, and pictures below 64 pixels are continued by their border
    inside the U-Net.

    Args:
        channels: colours of the measurement.
        width: feature channels of the U-Net at full resolution.
        iterations: of ADMM.
        threshold: start value of tau / mu2, see `LeAdmm`.

    References:
        K. Monakhova et al., Learned reconstructions for practical mask-based lensless imaging, Optics Express 27,
        28075 (2019); github.com/Waller-Lab/LenslessLearning.
    """

    def __init__(self, *, channels: int = 3, width: int = 24, iterations: int = 5, threshold: float = 2e-4) -> None:
        super().__init__()
        self.channels = channels
        self.admm = LeAdmm(iterations=iterations, threshold=threshold)
        self.denoiser = Denoiser(channels, width=width)

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """Transfer function of the PSF, see `LeAdmm`."""
        return self.admm.prepare(psf, size)

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W)."""
        height, width = measurement.shape[-2:]
        scene = self.admm.reconstruct(measurement, prepared)
        return self.denoiser(at_least(scene, SMALLEST))[..., :height, :width]
