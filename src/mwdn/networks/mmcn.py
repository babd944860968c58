"""MMCN, the model-mismatch compensation network: unrolled ADMM, a compensation branch and a U-Net."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import check_channels, convolutions, pad_to_minimum
from mwdn.networks.denoising_unet import MINIMUM_SIDE, WIDTHS, DenoisingUNet, scaled_widths
from mwdn.networks.le_admm import LeAdmm, divide_by_maximum
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size


class ResidualBlock(nn.Module):
    """Convolution, BatchNorm, ReLU, convolution, BatchNorm, skip connection, ReLU."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            *convolutions(channels, channels, bias=False),
            nn.Conv2d(channels, channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same shape."""
        return F.relu(x + self.body(x))


class Mmcn(Network[Tensor]):
    """Le-ADMM-U with a branch that compensates model errors, from the measurement and every iterate.

    18,863,559 learnable parameters. No source gives a count.

    From the source: K = 5 iterations s^1..s^K of learned ADMM; ``h_1 = f_1(b)``, ``h_{k+1} = f_{k+1}(h_k, g_k(s^k))``.
    f is two 3x3 convolutions with BatchNorm and ReLU, then max-pooling. g is a residual block, max-pooled to the scale
    of h_k. h_K joins the bottleneck features of the U-Net that denoises s^K.

    Inferred, as there is no public code: f has the widths of Le-ADMM-U's encoder, so that h_5, at 1/32, has the
    bottleneck's scale; g keeps the number of colours; features are concatenated; convolutions have no bias; iterations
    and U-Net are those of Le-ADMM-U, with each iterate divided by its maximum.

    Args:
        channels: colours of the measurement.
        width: feature channels of U-Net and branch at full resolution.

    References:
        T. Zeng and E. Y. Lam, Robust reconstruction with deep learning to handle model mismatch in lensless imaging,
        IEEE Trans. Comput. Imaging 7, 1080 (2021).
    """

    def __init__(self, *, channels: int = 3, width: int = WIDTHS[0]) -> None:
        super().__init__()
        self.channels = channels
        widths = scaled_widths(width)
        self.admm = LeAdmm(iterations=len(widths))
        inputs = (channels, *(features + channels for features in widths[:-1]))
        self.branch = nn.ModuleList(
            convolutions(before, after, after, bias=False) for before, after in zip(inputs, widths, strict=True)
        )
        self.residuals = nn.ModuleList(ResidualBlock(channels) for _ in widths[:-1])
        self.denoiser = DenoisingUNet(channels, width=width, bottleneck_channels=widths[-1])

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """Transfer function of the PSF, see `LeAdmm`."""
        return self.admm.prepare(psf, size)

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W)."""
        check_channels(measurement, self.channels)
        height, width = measurement.shape[-2:]
        iterates = self.admm.iterates(measurement, prepared)
        scenes = [pad_to_minimum(divide_by_maximum(scene), MINIMUM_SIDE) for scene in iterates]
        features = F.max_pool2d(self.branch[0](pad_to_minimum(measurement, MINIMUM_SIDE)), 2)
        for k, (f, g) in enumerate(zip(self.branch[1:], self.residuals, strict=True)):
            compensation = g(scenes[k])
            for _ in range(k + 1):
                compensation = F.max_pool2d(compensation, 2)
            features = F.max_pool2d(f(torch.cat([features, compensation], dim=1)), 2)
        return self.denoiser(scenes[-1], features)[..., :height, :width]
