"""Captures of a camera without their scenes, for self-supervised training."""

import hashlib
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import check_not_negative, checked
from mwdn.data.random import seeded
from mwdn.data.simulated import NumberedSamples, full_precision
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import convolve
from mwdn.optics.noise import noise_level
from mwdn.solvers.alignment import align
from mwdn.solvers.pose import Pose
from mwdn.types import Image, Measurement, Psf, Scene


@checked
@dataclass(frozen=True)
class SelfSupervised:
    """The [selfsupervised] of a recipe: learn from captures without scenes.

    Args:
        consistency: weight of the part of a measurement that its reconstruction, convolved with the PSF, does not
            explain; 0 for a recipe that learns from pairs.
        equivariance: weight of the [loss] between a moved reconstruction and the network's reconstruction of its
            simulated capture. Without it, nothing constrains what the camera does not see.
        recorruption: r, which splits the noise between the measurement to reconstruct, whose noise is multiplied by
            sqrt(1 + r^2), and the one to explain, sqrt(1 + 1 / r^2). At 0 both are the measurement itself, and the
            network learns to explain its noise too.
        shift: largest displacement of the reconstruction, as a fraction of each side.
    """

    consistency: float = 0.0
    equivariance: float = 1.0
    recorruption: float = 0.5
    shift: float = 0.1

    def __post_init__(self) -> None:
        check_not_negative(consistency=self.consistency, equivariance=self.equivariance, recorruption=self.recorruption)
        if not 0 <= self.shift < 1:
            raise ParameterError(f"`shift` ({self.shift}) must be in [0, 1): it is a fraction of each side.")


class CaptureBatch(NamedTuple):
    """Captures for a network that learns without scenes.

    Args:
        measurement: (B, C, H, W), to reconstruct.
        target: (B, C, H, W), to explain: the same light with independent noise.
        psf: (B, 1 or C, H, W), aligned to each capture.
    """

    measurement: Measurement
    target: Measurement
    psf: Psf


@dataclass(frozen=True, eq=False)
class UnpairedCaptures(NumberedSamples):
    """Captures as numbered samples: each once per epoch, in another order, its noise split in another way.

    Args:
        measurements: (N, C, H, W).
        psf: (1, 1 or C, H, W), of the calibration. It is aligned to each capture when that is first used.
        settings: how noise is split and scenes are moved.
        seed: of orders, noise and moves.
        poses: of the aligned PSF, by the capture's position; filled on first use.
    """

    measurements: Measurement
    psf: Psf
    settings: SelfSupervised = SelfSupervised()
    seed: int = 0
    poses: dict[int, Pose] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.measurements)

    @property
    def name(self) -> str:
        """States the content of the captures."""
        content = self.measurements.cpu().contiguous().numpy().tobytes()
        return f"{len(self):,} captures {hashlib.sha256(content).hexdigest()[:16]}"

    @full_precision
    def batch(self, numbers: range | list[int]) -> CaptureBatch:
        """Two measurements of each capture, with independent noise, and its aligned PSF.

        For the measurement y, the noise level sigma, a random n of unit variance and the recorruption r they are
        y + r sigma n and y - sigma n / r. Their noise is uncorrelated: explaining the second by the first gains nothing
        from reproducing noise.

        References:
            T. Pang et al., Recorrupted-to-Recorrupted: unsupervised deep learning for image denoising, CVPR (2021).
        """
        rows = [self.row(number) for number in numbers]
        captures, r = self.measurements[rows], self.settings.recorruption
        psf = torch.cat([self._pose(row).move(self.psf) for row in rows])
        if r == 0:
            return CaptureBatch(captures, captures, psf)
        noise = noise_level(captures) * self._normal(numbers)
        return CaptureBatch(captures + r * noise, captures - noise / r, psf)

    def row(self, number: int) -> int:
        """Position of a sample's capture."""
        epoch, place = divmod(number, len(self))
        return int(torch.randperm(len(self), generator=self._generator(epoch))[place])

    @full_precision
    def recapture(self, scene: Scene, psf: Psf, light: Tensor, numbers: range | list[int]) -> tuple[Measurement, Scene]:
        """Move scenes at random and simulate captures of them.

        Args:
            scene: (B, C, H, W), of the samples of these numbers.
            psf: (B, C, H, W), aligned to each capture.
            light: (B, C, 1, 1), uniform stray light.
            numbers: seed the moves and the noise, which is as strong as that of the capture.

        Returns:
            The measurement, and the moved scene: shifted, mirrored, and transposed at random if it is square.
        """
        moved = torch.stack([self._moved(one, number) for one, number in zip(scene, numbers, strict=True)])
        noise = noise_level(self.measurements[[self.row(number) for number in numbers]]) * self._normal(numbers, 1)
        return convolve(moved, psf) + light + noise, moved

    def _moved(self, scene: Tensor, number: int) -> Tensor:
        generator = self._generator(number, 2)
        flips = torch.randint(2, (3,), generator=generator).tolist()
        parts = self.settings.shift * (2 * torch.rand(2, generator=generator) - 1)
        down, right = (int(part * length) for part, length in zip(parts.tolist(), scene.shape[-2:], strict=True))
        scene = F.pad(scene, (right, -right, down, -down))
        scene = scene.flip([axis for axis, flip in zip((-2, -1), flips, strict=False) if flip])
        return scene.transpose(-2, -1) if flips[2] and scene.shape[-2] == scene.shape[-1] else scene

    def _pose(self, row: int) -> Pose:
        if row not in self.poses:
            self.poses[row] = align(self.measurements[row : row + 1], self.psf)
        return self.poses[row]

    def _normal(self, numbers: range | list[int], purpose: int = 0) -> Image:
        shape = self.measurements.shape[1:]
        noise = [torch.randn(shape, generator=self._generator(number, purpose)) for number in numbers]
        return torch.stack(noise).to(self.measurements)

    def _generator(self, number: int, purpose: int = 3) -> torch.Generator:
        """A separate generator for each sample and purpose."""
        return seeded(4 * (self.seed * 1_000_003 + number) + purpose)
