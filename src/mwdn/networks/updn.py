"""Unrolled primal-dual network with learned PSFs."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.fourier.convolution import Convolution
from mwdn.networks.blocks import check_channels, peak_one_in_colour, resized
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size, Transfer


def _rectified(*widths: int) -> nn.Sequential:
    """(3x3 convolution without bias, ReLU) from each of ``widths`` to the next."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class SmallUNet(nn.Module):
    """U-Net of UPDN: five scales, no normalisation, transposed convolutions upwards.

    Args:
        inputs: channels of the pictures.
        width: feature channels at full resolution, doubled at each scale.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        widths = [width * 2**scale for scale in range(5)]
        self.encoders = nn.ModuleList(
            _rectified(before, own, own) for before, own in zip((inputs, *widths), widths, strict=False)
        )
        self.ups = nn.ModuleList(nn.ConvTranspose2d(2 * own, own, 2, stride=2) for own in widths[-2::-1])
        self.decoders = nn.ModuleList(_rectified(2 * own, own, own) for own in widths[-2::-1])
        self.head = nn.Conv2d(width, 1, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """One channel (B, 1, H, W) of at least 16 pixels along each side."""
        x, skips = self.encoders[0](pictures), []
        for encoder in self.encoders[1:]:
            skips.append(x)
            x = encoder(F.max_pool2d(x, 2))
        for up, decoder, skip in zip(self.ups, self.decoders, reversed(skips), strict=True):
            # An odd row or column, which pooling dropped, is filled with the bias.
            x = up(x, output_size=skip.shape[-2:])
            x = decoder(torch.cat([x, skip], dim=1))
        return self.head(x)


class PrimalDual(nn.Module):
    """One iteration: the dual, on the sensor, moves by what the scenes cast there; then the scenes by the dual.

    Args:
        width: scenes, and PSFs, side by side.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        dual, primal = 2 * width + 1, 2 * width
        self.dual = nn.Sequential(
            nn.Conv2d(dual, 2 * dual, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(2 * dual, width, 1)
        )
        self.primal = nn.Sequential(
            nn.Conv2d(primal, 2 * primal, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(2 * primal, width, 1)
        )

    def forward(self, primal: Tensor, dual: Tensor, b: Tensor, camera: Convolution) -> tuple[Tensor, Tensor]:
        """The next scenes and duals, (B * colours, width, ...)."""
        # The camera has the colours beside the scenes: (B, colours * width, ...).
        batch, width = b.shape[0] * dual.shape[1] // camera.transfer.shape[1], dual.shape[1]
        cast = camera.forward(primal.reshape(batch, -1, *camera.scene)).reshape(-1, width, *camera.sensor)
        dual = dual + self.dual(torch.cat([cast, dual, b], dim=1))
        back = camera.adjoint(dual.reshape(batch, -1, *camera.sensor)).reshape(-1, width, *camera.scene)
        return primal + self.primal(torch.cat([back, primal], dim=1)), dual


class Updn(Network[Tensor]):
    """Ten learned primal-dual steps through five learned PSFs, then a small U-Net.

    2,744,411 learnable numbers at 270 x 480: 5 x 3 x 270 x 480 = 1,944,000 of the PSFs, 42,400 of the steps, 758,011 of
    the U-Net.

    From the source: five scenes, each with its own PSF, all of which begin as the measured one; steps that share
    nothing; scenes on a grid of twice the sensor, both they and the duals from zero; colours treated alike, as samples
    of the batch; output the sigmoid of the first scene plus what the U-Net makes of all five.

    Different here: what is learned of a PSF is its difference from the measured one, which is an input. With one camera
    that is the same; the measured PSF can be exchanged. The differences belong to one size of sensor, ``size``, and are
    stretched to any other. PSFs are scaled to a peak of 1, where the differences are learned, and then to a mean sum of
    1, so that the steps see the same gain at every size (the source leaves it to orthonormal transforms). A row or
    column that the U-Net's pooling drops is added wherever the size is odd, not only as 270 x 480 needs it.

    Args:
        channels: colours of the measurement.
        width: scenes side by side; half the U-Net's channels at full resolution.
        depth: steps.
        size: height and width of the sensor whose PSFs are learned; ``None`` keeps the measured one.

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
        """Learned PSFs, (1 or B, C * width, H, W), of mean sum 1 before their correction."""
        psf = peak_one_in_colour(psf, size, self.channels)[:, :, None]
        total = psf.sum((-2, -1), keepdim=True).mean(1, keepdim=True)
        if self.correction is not None:
            psf = psf + resized(self.correction, size)
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
        # Scene and sensor share their centre.
        top, left = height - height // 2, width - width // 2
        scenes = primal[..., top : top + height, left : left + width]
        return torch.sigmoid(scenes[:, :1] + self.unet(scenes)).reshape(measurement.shape)
