"""Learning from real captures without their scenes.

Many scenes explain a measurement y: the sensor crops the pattern, and the PSF suppresses some frequencies. The loss has
two parts. Consistency: the reconstruction x = f(y), convolved with the PSF, must explain y. Equivariance: x is moved
(shifted, mirrored, transposed) to T x and captured again in simulation; the network must reconstruct T x from it. This
penalises what the network invents or omits where the camera measures nothing. T x has no gradient in the comparison
(the papers propagate gradients through it): the network learns to find scenes, not to make scenes that are easy to
find.

Alignment: each capture has its aligned PSF (`UnpairedCaptures.batch`), used to explain it and to capture again. In
training and validation alike the network gets this PSF if it is used with an aligned one (``network.align``), otherwise
the PSF of the calibration.

References:
    D. Chen, J. Tachella, M. Davies, Equivariant imaging: learning beyond the range space, ICCV (2021).
    D. Chen, J. Tachella, M. Davies, Robust equivariant imaging, CVPR (2022).
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from mwdn.data.unpaired import UnpairedCaptures
from mwdn.fourier.convolution import convolve
from mwdn.networks import Network
from mwdn.training.losses import Loss
from mwdn.training.tasks import Scores
from mwdn.types import TINY, Image, Measurement


class SelfSupervisedLoss(NamedTuple):
    """Loss without scenes.

    Args:
        loss: to be minimised, a scalar.
        parts: before their weights, scalars without gradient.
        pictures: measurement, reconstruction, and the reconstruction convolved with the PSF.
    """

    loss: Tensor
    parts: dict[str, Tensor]
    pictures: tuple[Tensor, Tensor, Tensor]


def selfsupervised_loss(
    captures: UnpairedCaptures, network: nn.Module, distance: Loss, numbers: range | list[int]
) -> SelfSupervisedLoss:
    """Consistency and equivariance of a network's reconstructions, see the top of this file.

    Args:
        captures: with the weights of both parts.
        network: measurement and PSF in, scene out.
        distance: of two scenes in [0, 1].
        numbers: of the samples.
    """
    measurement, target, psf = captures.batch(numbers)
    network_psf = psf if isinstance(network, Network) and network.align else captures.psf
    reconstruction = network(measurement.contiguous(memory_format=torch.channels_last), network_psf).float()
    explained = convolve(reconstruction, psf)
    light = (target - explained).mean((-2, -1), keepdim=True).detach()
    inconsistency = unexplained(explained, target).mean()
    recaptured, scene = captures.recapture(reconstruction.detach().clamp(min=0), psf, light, numbers)
    again = network(recaptured.contiguous(memory_format=torch.channels_last), network_psf).float()
    brightest = scene.amax((1, 2, 3), keepdim=True).clamp(min=1e-6)
    equivariance, parts = distance(again / brightest, scene / brightest)
    total = captures.settings.consistency * inconsistency + captures.settings.equivariance * equivariance
    pictures = measurement, reconstruction.detach(), explained.detach()
    return SelfSupervisedLoss(total, {"unexplained": inconsistency.detach(), **parts}, pictures)


def unexplained(explained: Image, measurement: Measurement) -> Tensor:
    """Unexplained fraction of a measurement's variance, (B,): 0 is best, a black reconstruction has 1.

    A constant offset per colour does not count: stray light reaches a sensor without a lens from everywhere.

    Args:
        explained: (B, C, H, W), a reconstruction convolved with the PSF.
        measurement: of the same shape.
    """
    residual, signal = (
        picture - picture.mean((-2, -1), keepdim=True) for picture in (measurement - explained, measurement)
    )
    power = signal.square().sum((1, 2, 3)).clamp(min=TINY)
    return residual.square().sum((1, 2, 3)) / power


@dataclass(frozen=True, eq=False)
class SelfSupervisedTask:
    """Learn from captures without scenes. Validation is on the same captures."""

    samples: UnpairedCaptures

    columns: ClassVar[tuple[str, str]] = "measurement", "through the camera"
    cache: ClassVar[None] = None

    @torch.no_grad()
    def check(self, network: nn.Module) -> None:
        """Reconstruct the first capture: one that does not fit the network is reported before training."""
        network(self.samples.measurements[:1], self.samples.psf)

    def loss(self, network: nn.Module, distance: Loss, numbers: range) -> tuple[Tensor, dict[str, Tensor]]:
        """The self-supervised loss of the captures of these numbers, and its parts."""
        result = selfsupervised_loss(self.samples, network, distance, numbers)
        return result.loss, result.parts

    def score(self, network: nn.Module, distance: Loss, numbers: range) -> Scores:
        """The same loss, with the weights of the training's current phase; ``psnr`` is the loss in dB below 1."""
        result = selfsupervised_loss(self.samples, network, distance, numbers)
        return Scores(-10 * torch.log10(result.loss).expand(len(numbers)), float(result.loss), result.pictures)
