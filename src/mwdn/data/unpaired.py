"""A camera's own captures as something to learn from, although nobody knows their scenes."""

import hashlib
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.data.random import seeded
from mwdn.data.simulated import Pair, full_precision
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import convolve
from mwdn.optics.noise import noise_level
from mwdn.solvers.alignment import Pose, align
from mwdn.types import Image, Measurement, Psf, Scene


@dataclass(frozen=True)
class SelfSupervised:
    """The [selfsupervised] of a recipe: learn from captures alone.

    Args:
        consistency: weight of the part of a measurement that its reconstruction, seen through the camera, leaves
            unexplained; 0 for a recipe that learns from pairs.
        equivariance: weight of the [loss] between a reconstruction moved elsewhere, and what the network makes of a
            capture of it. Without it the network may leave out what the camera does not see.
        recorruption: how unevenly the noise is split between the measurement that is reconstructed, whose noise
            rises by sqrt(1 + its square), and the one to be explained, sqrt(1 + 1 / its square). With 0 both are the
            measurement itself, whose noise is then explained too.
        shift: largest displacement of the reconstruction, as a part of each side.
    """

    consistency: float = 0.0
    equivariance: float = 1.0
    recorruption: float = 0.5
    shift: float = 0.1

    def __post_init__(self) -> None:
        for name in ("consistency", "equivariance", "recorruption"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must not be negative.")
        if not 0 <= self.shift < 1:
            raise ParameterError(f"`shift` ({self.shift}) must be in [0, 1): a part of each side.")


@dataclass(frozen=True, eq=False)
class UnpairedCaptures:
    """A source of captures: each once, in another order, in each epoch, its noise split in another way.

    Args:
        measurements: (N, C, H, W).
        psf: (1, 1 or C, H, W), of the calibration. Each capture's own, turned and scaled, is found when first needed.
        settings: how noise is split, and scenes are moved.
        seed: of orders, noise and moves.
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
        """Tells these captures from others."""
        content = self.measurements.cpu().contiguous().numpy().tobytes()
        return f"{len(self):,} captures {hashlib.sha256(content).hexdigest()[:16]}"

    @full_precision
    def batch(self, numbers: range | list[int]) -> Pair:
        """Measurements of these numbers, twice, each with independent noise, and their own PSFs.

        In place of a scene stands what is to be explained: a measurement of the same light, whose noise knows nothing
        of the first one's, so that whoever explains it cannot gain by explaining noise.

        References:
            T. Pang et al., Recorrupted-to-Recorrupted: unsupervised deep learning for image denoising, CVPR (2021).
        """
        rows = [self.row(number) for number in numbers]
        taken, uneven = self.measurements[rows], self.settings.recorruption
        psf = torch.cat([self._pose(row).move(self.psf) for row in rows])
        if uneven == 0:
            return Pair(taken, taken, psf)
        noise = noise_level(taken) * self._normal(numbers)
        return Pair(taken + uneven * noise, taken - noise / uneven, psf)

    def row(self, number: int) -> int:
        """Which capture a sample is of."""
        epoch, place = divmod(number, len(self))
        return int(torch.randperm(len(self), generator=self._generator(epoch))[place])

    @full_precision
    def again(self, scene: Scene, psf: Psf, light: Tensor, numbers: range | list[int]) -> tuple[Measurement, Scene]:
        """Move scenes elsewhere and capture them once more.

        Args:
            scene: (B, C, H, W), of the samples of these numbers.
            psf: (B, C, H, W), their own.
            light: (B, C, 1, 1), even light on their sensors that is from elsewhere.
            numbers: decide about moves and noise, as strong as that of the capture.

        Returns:
            The measurement, and the scene that it is of: shifted, mirrored, turned by right angles if it is square.
        """
        moved = torch.stack([self._moved(one, number) for one, number in zip(scene, numbers, strict=True)])
        noise = noise_level(self.measurements[[self.row(number) for number in numbers]]) * self._normal(numbers, 1)
        return convolve(moved, psf) + light + noise, moved

    def _moved(self, scene: Tensor, number: int) -> Tensor:
        generator = self._generator(number, 2)
        ways = torch.randint(2, (3,), generator=generator).tolist()
        down, right = (
            int(part * length)
            for part, length in zip(
                (self.settings.shift * (2 * torch.rand(2, generator=generator) - 1)).tolist(),
                scene.shape[-2:],
                strict=True,
            )
        )
        scene = F.pad(scene, (right, -right, down, -down))
        scene = scene.flip([axis for axis, way in zip((-2, -1), ways, strict=False) if way])
        return scene.transpose(-2, -1) if ways[2] and scene.shape[-2] == scene.shape[-1] else scene

    def _pose(self, row: int) -> Pose:
        if row not in self.poses:
            self.poses[row] = align(self.measurements[row : row + 1], self.psf)
        return self.poses[row]

    def _normal(self, numbers: range | list[int], purpose: int = 0) -> Image:
        shape = self.measurements.shape[1:]
        drawn = [torch.randn(shape, generator=self._generator(number, purpose)) for number in numbers]
        return torch.stack(drawn).to(self.measurements)

    def _generator(self, number: int, purpose: int = 3) -> torch.Generator:
        """Of its own for each sample and purpose."""
        return seeded(4 * (self.seed * 1_000_003 + number) + purpose)
