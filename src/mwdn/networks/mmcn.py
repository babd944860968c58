"""Model-mismatch compensation network: unrolled ADMM, a compensation branch beside it, a U-Net behind it."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import at_least, check_channels, convolutions
from mwdn.networks.denoiser import SMALLEST, WIDTHS, Denoiser, scaled_widths
from mwdn.networks.le_admm import LeAdmm, brightest_one
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size


class Residual(nn.Module):
    """Convolution, BatchNorm, ReLU, convolution, BatchNorm; then the input is added, and a ReLU."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            *convolutions(channels, channels, bias=False),
            nn.Conv2d(channels, channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same size and number."""
        return F.relu(x + self.body(x))


class Mmcn(Network[Tensor]):
    """Le-ADMM-U with a branch that sees the measurement and every iterate, and compensates what the model gets wrong.

    From the source: K = 5 iterations s^1..s^K of learned ADMM; ``h_1 = f_1(b)``, ``h_{k+1} = f_{k+1}(h_k, g_k(s^k))``
    with f two 3x3 convolutions with BatchNorm and ReLU, then max-pooling, and g a residual block brought to the scale
    of h_k by max-pooling; h_K joins the bottleneck of the U-Net that denoises s^K.

    Inferred, as there is no public code: f's widths are those of Le-ADMM-U's encoder, so that h_5, at 1/32, has the
    bottleneck's scale; g keeps the number of colours; features are joined by concatenation; convolutions have no bias,
    and iterations and U-Net are those of Le-ADMM-U, divided by the maximum in between. 18,863,559 learnable numbers,
    a count that no source gives.

    Args:
        channels: colours of the measurement.
        width: feature channels at full resolution, of U-Net and branch.

    References:
        T. Zeng and E. Y. Lam, Robust reconstruction with deep learning to handle model mismatch in lensless imaging,
        IEEE Trans. Comput. Imaging 7, 1080 (2021).
    """

    def __init__(self, *, channels: int = 3, width: int = WIDTHS[0]) -> None:
        super().__init__()
        self.channels = channels
        widths = scaled_widths(width)
        self.admm = LeAdmm(iterations=len(widths))
        inputs = (channels, *(own + channels for own in widths[:-1]))
        self.branch = nn.ModuleList(
            convolutions(before, own, own, bias=False) for before, own in zip(inputs, widths, strict=True)
        )
        self.residuals = nn.ModuleList(Residual(channels) for _ in widths[:-1])
        self.denoiser = Denoiser(channels, width=width, joining=widths[-1])

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """Transfer function of the PSF, see `LeAdmm`."""
        return self.admm.prepare(psf, size)

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W)."""
        check_channels(measurement, self.channels)
        height, width = measurement.shape[-2:]
        scenes = [at_least(brightest_one(each), SMALLEST) for each in self.admm.iterates(measurement, prepared)]
        features = F.max_pool2d(self.branch[0](at_least(measurement, SMALLEST)), 2)
        for k, (f, g) in enumerate(zip(self.branch[1:], self.residuals, strict=True)):
            compensation = g(scenes[k])
            for _ in range(k + 1):
                compensation = F.max_pool2d(compensation, 2)
            features = F.max_pool2d(f(torch.cat([features, compensation], dim=1)), 2)
        return self.denoiser(scenes[-1], features)[..., :height, :width]
