"""UPDN: unrolled primal-dual network with learned PSFs."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.fourier.convolution import Convolution
from mwdn.networks.blocks import check_channels, check_sides, resize
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import normalise_psf
from mwdn.types import Measurement, Psf, Scene, Size, Transfer


def _rectified(*widths: int) -> nn.Sequential:
    """A 3x3 convolution without bias and a ReLU from each of ``widths`` to the next."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class SmallUNet(nn.Module):
    """U-Net of UPDN: five scales, no normalisation, upsampling by transposed convolutions.

    Args:
        inputs: channels of the pictures.
        width: feature channels at full resolution, doubled at each scale.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        widths = [width * 2**scale for scale in range(5)]
        self.encoders = nn.ModuleList(_rectified(before, after, after) for before, after in pairwise((inputs, *widths)))
        self.ups = nn.ModuleList(nn.ConvTranspose2d(2 * after, after, 2, stride=2) for after in widths[-2::-1])
        self.decoders = nn.ModuleList(_rectified(2 * after, after, after) for after in widths[-2::-1])
        self.head = nn.Conv2d(width, 1, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """One channel (B, 1, H, W); height and width must be at least 16."""
        x, skips = self.encoders[0](pictures), []
        for encoder in self.encoders[1:]:
            skips.append(x)
            x = encoder(F.max_pool2d(x, 2))
        for up, decoder, skip in zip(self.ups, self.decoders, reversed(skips), strict=True):
            # The odd row or column that pooling dropped gets the bias only.
            x = up(x, output_size=skip.shape[-2:])
            x = decoder(torch.cat([x, skip], dim=1))
        return self.head(x)


class PrimalDual(nn.Module):
    """One iteration: a CNN updates the dual (sensor) from ``H primal``, another the primal (scene) from ``H^T dual``.

    Args:
        width: number of scenes and PSFs.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.dual, self.primal = (
            nn.Sequential(nn.Conv2d(n, 2 * n, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(2 * n, width, 1))
            for n in (2 * width + 1, 2 * width)
        )

    def forward(self, primal: Tensor, dual: Tensor, b: Tensor, camera: Convolution) -> tuple[Tensor, Tensor]:
        """Updated scenes and duals, (B * colours, width, ...)."""
        # The camera expects colours and scenes in one dimension: (B, colours * width, ...).
        batch, width = b.shape[0] * dual.shape[1] // camera.transfer.shape[1], dual.shape[1]
        pattern = camera.forward(primal.reshape(batch, -1, *camera.scene)).reshape(-1, width, *camera.sensor)
        dual = dual + self.dual(torch.cat([pattern, dual, b], dim=1))
        back = camera.adjoint(dual.reshape(batch, -1, *camera.sensor)).reshape(-1, width, *camera.scene)
        return primal + self.primal(torch.cat([back, primal], dim=1)), dual


class Updn(Network[Tensor]):
    """Ten unrolled primal-dual iterations with five learned PSFs, then a small U-Net.

    2,744,411 learnable parameters at 270 x 480: 5 x 3 x 270 x 480 = 1,944,000 of the PSFs, 42,400 of the iterations,
    758,011 of the U-Net.

    From the source: five scenes, each with its own PSF, initialised as the measured one; iterations do not share
    weights; scenes on a grid of twice the sensor; scenes and duals start at zero; colours are treated as samples of the
    batch; the output is the sigmoid of the first scene plus the U-Net's output for all five.

    Different here:

    - Each PSF is learned as a correction of the measured one, which is an input. For one camera this is equivalent.
      Corrections are stored for one sensor size, ``size``, and resampled to any other.
    - Corrections are added at a PSF peak of 1. The PSFs are then scaled to a mean sum of 1, so that the gain does not
      depend on the size (the source relies on orthonormal transforms).
    - Rows and columns dropped by the U-Net's pooling are filled at every odd size, not only for 270 x 480.

    Args:
        channels: colours of the measurement.
        width: number of scenes; half the U-Net's channels at full resolution.
        depth: number of iterations.
        size: height and width for which the corrections are stored; ``None`` for none.

    References:
        O. Kingshott et al., Unrolled primal-dual networks for lensless cameras, Optics Express 30, 46324 (2022);
        github.com/oliland/lensless-primal-dual.
    """

    def __init__(self, *, channels: int = 3, width: int = 5, depth: int = 10, size: Size | None = (270, 480)) -> None:
        super().__init__()
        self.channels, self.width = channels, width
        self.correction = None if size is None else nn.Parameter(torch.zeros(channels, width, *size))
        self.steps = nn.ModuleList(PrimalDual(width) for _ in range(depth))
        self.unet = SmallUNet(width, 2 * width)

    def psfs(self, psf: Psf, size: Size) -> Tensor:
        """Learned PSFs, (1 or B, C * width, H, W), of mean sum 1 before correction."""
        check_sides(psf, len(self.unet.ups))
        psf = normalise_psf(psf, size, self.channels)[:, :, None]
        total = psf.sum((-2, -1), keepdim=True).mean(1, keepdim=True)
        if self.correction is not None:
            psf = psf + resize(self.correction, size)
        return (psf / total).expand(-1, -1, self.width, -1, -1).flatten(1, 2)

    def prepare(self, psf: Psf, size: Size) -> Transfer:
        """Transfer functions of the learned PSFs, (1 or B, C * width, ...)."""
        return Convolution.from_psf(self.psfs(psf, size), (2 * size[0], 2 * size[1]), size).transfer

    def reconstruct(self, measurement: Measurement, prepared: Transfer) -> Scene:
        """Scene (B, C, H, W), between 0 and 1."""
        check_channels(measurement, self.channels)
        height, width = measurement.shape[-2:]
        camera = Convolution.from_transfer(prepared, (2 * height, 2 * width), (height, width))
        b = measurement.float().reshape(-1, 1, height, width)
        dual = b.new_zeros(b.shape[0], self.width, height, width)
        primal = b.new_zeros(b.shape[0], self.width, 2 * height, 2 * width)
        for step in self.steps:
            primal, dual = step(primal, dual, b, camera)
        # The sensor faces the centre of the scene.
        top, left = height - height // 2, width - width // 2
        scenes = primal[..., top : top + height, left : left + width]
        return torch.sigmoid(scenes[:, :1] + self.unet(scenes)).reshape(measurement.shape)
