"""What a network's reconstructions of real captures are worth, although nobody knows the scenes."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mwdn.data.unpaired import UnpairedCaptures
from mwdn.fourier.convolution import convolve
from mwdn.networks import Network
from mwdn.training.losses import Loss
from mwdn.training.validation import START, Judged, Validator, reconstruct
from mwdn.types import Image, Measurement


class Blind(NamedTuple):
    """What was found without a scene.

    Args:
        loss: to be minimised, a scalar.
        parts: of it before their weights, scalars without gradient.
        pictures: measurement, reconstruction, and the reconstruction seen through the camera.
    """

    loss: Tensor
    parts: dict[str, Tensor]
    pictures: tuple[Tensor, Tensor, Tensor]


def judge(captures: UnpairedCaptures, network: nn.Module, loss: Loss, numbers: range | list[int]) -> Blind:
    """Let the network reconstruct captures, and see whether its pictures explain them and stand a second capture.

    Many scenes explain a measurement: the sensor crops the pattern, and a PSF passes hardly anything of some
    frequencies. What a network invents or leaves out there shows when its picture is moved and captured again: if the
    picture was possible, so is the moved one, and the network should find it. That picture is held fixed for the
    comparison (the papers let it move too): the network learns to find scenes, not to make scenes that are found.

    Args:
        captures: and how the parts are weighted.
        network: measurement and PSF in, scene out.
        loss: distance of two scenes in [0, 1].
        numbers: of the samples.

    References:
        D. Chen, J. Tachella, M. Davies, Equivariant imaging: learning beyond the range space, ICCV (2021).
        D. Chen, J. Tachella, M. Davies, Robust equivariant imaging, CVPR (2022).
    """
    measurement, other, psf = captures.batch(numbers)
    assert psf is not None
    # A network whose PSF is aligned at inference is trained on the PSF that fits the capture.
    told = psf if isinstance(network, Network) and network.align else captures.psf
    found = network(measurement.contiguous(memory_format=torch.channels_last), told).float()
    seen = convolve(found, psf)
    light = (other - seen).mean((-2, -1), keepdim=True).detach()
    left = unexplained(seen, other).mean()
    captured, scene = captures.again(found.detach().clamp(min=0), psf, light, numbers)
    again = network(captured.contiguous(memory_format=torch.channels_last), told).float()
    brightest = scene.amax((1, 2, 3), keepdim=True).clamp(min=1e-6)
    distance, parts = loss(again / brightest, scene / brightest)
    total = captures.settings.consistency * left + captures.settings.equivariance * distance
    return Blind(total, {"unexplained": left.detach(), **parts}, (measurement, found.detach(), seen.detach()))


def unexplained(seen: Image, measurement: Measurement) -> Tensor:
    """Part of a measurement's variation that stays unexplained, (B,): 0 at best, 1 for a picture of nothing.

    Even light of each colour is free: on a sensor without a lens it falls from everywhere.

    Args:
        seen: (B, C, H, W), a reconstruction through the camera.
        measurement: of the same shape.
    """
    left, all_of_it = (picture - picture.mean((-2, -1), keepdim=True) for picture in (measurement - seen, measurement))
    power = all_of_it.square().sum((1, 2, 3)).clamp(min=torch.finfo(torch.float32).tiny)
    return left.square().sum((1, 2, 3)) / power


@dataclass(frozen=True, eq=False)
class BlindValidator(Validator):
    """Validates a network on captures alone; the sheet shows its pictures seen through the camera again.

    In place of the PSNR stands the loss in dB below 1.
    """

    columns = ("measurement", "through the camera")

    def judged(self, network: nn.Module, loss: Loss, numbers: range) -> Judged:
        """The loss has the weights that [loss] has at the moment."""
        assert isinstance(self.pairs, UnpairedCaptures)
        found = judge(self.pairs, network, loss, numbers)
        return Judged(-10 * torch.log10(found.loss).expand(len(numbers)), float(found.loss), found.pictures)

    @torch.no_grad()
    def captured(self, network: nn.Module) -> list[list[Tensor]]:
        """The first capture and its reconstruction: whether it fits the network is found before training."""
        measurement, _, _ = self.pairs.batch([START])
        return [[measurement.cpu(), reconstruct(network, measurement, self.psf).cpu()]]
