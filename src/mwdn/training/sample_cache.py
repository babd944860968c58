"""Samples that are kept: what a network computes of them before its learned part is computed once."""

import torch
from torch import Tensor, nn

from mwdn.data.random import seeded
from mwdn.data.simulated import Samples
from mwdn.errors import ParameterError
from mwdn.types import Psf


class Pool:
    """A finite number of samples, used again and again, each time mirrored or turned another way.

    For networks whose forward pass is ``correct(estimates, unit(estimates))``, where ``estimates`` of the measurement
    and the PSF have nothing to learn.
    A sample enters when it is first needed, so a run begins at once and a stopped one goes on as it would have.

    Args:
        pairs: where the samples come from; its numbers 0 to ``size`` - 1 are used.
        network: computes the estimates.
        psf: of the camera, where the pairs have none of their own.
        size: how many samples are kept, as half precision in memory: 4 MB each at 320 x 320. A multiple of ``batch``.
        crop: side of the square that is cut out at random each time; 0 for the whole frame.
        batch: samples of a step. Each place in a batch has samples of its own, so that each process keeps its own.
        seed: of their order.

    Raises:
        ParameterError: the network learns in its estimates, or has none; or the size is no multiple of the batch.
    """

    def __init__(
        self, pairs: Samples, network: nn.Module, psf: Psf, *, size: int, batch: int, crop: int, seed: int
    ) -> None:
        if size % batch:
            raise ParameterError(f"`pool` ({size}) must be a multiple of `batch` ({batch}).")
        if not (hasattr(network, "estimates") and hasattr(network, "correct")):
            raise ParameterError(
                f"`pool` ({size}) keeps what a network computes before it learns; {type(network).__name__} learns from "
                "the first step on. Set `pool = 0`."
            )
        self.pairs, self.network, self.psf = pairs, network, psf
        self.size, self.together, self.crop, self.seed = size, batch, crop, seed
        self.kept: dict[int, tuple[Tensor, Tensor, Tensor]] = {}

    def batch(self, numbers: range | list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Estimates, units and scenes of the samples of these numbers, which may be of any epoch."""
        with torch.autocast(self.psf.device.type, enabled=False):
            samples = [self._turned(number) for number in numbers]
            estimates, units, scenes = (torch.stack(each).float() for each in zip(*samples, strict=True))
        return estimates, units, scenes

    def _turned(self, number: int) -> tuple[Tensor, Tensor, Tensor]:
        epoch, place = divmod(number, self.size)
        step, slot = divmod(place, self.together)
        generator = seeded((self.seed * 1_000_003 + epoch) * self.together + slot)
        order = torch.randperm(self.size // self.together, generator=generator)
        generator = seeded(self.seed * 1_000_003 + number + 1)  # now for this sample alone
        estimates, unit, scene = self._sample(int(order[step]) * self.together + slot)
        # The mirror images of a square; a frame of two lengths is not turned on its side.
        way = epoch + place
        axes = [axis for axis, bit in ((-1, 1), (-2, 2)) if way & bit]
        estimates, scene = estimates.flip(axes), scene.flip(axes)
        if way & 4 and scene.shape[-2] == scene.shape[-1]:
            estimates, scene = estimates.transpose(-2, -1), scene.transpose(-2, -1)
        if self.crop:
            height, width = (min(self.crop, length) for length in scene.shape[-2:])
            at = torch.rand(2, generator=generator)
            top, left = (int(at[i] * (scene.shape[i - 2] - side + 1)) for i, side in enumerate((height, width)))
            part = (..., slice(top, top + height), slice(left, left + width))
            estimates, scene = estimates[part], scene[part]
        return estimates, unit, scene

    @torch.no_grad()
    def _sample(self, row: int) -> tuple[Tensor, Tensor, Tensor]:
        if row not in self.kept:
            measurement, scene, psf = self.pairs.batch([row])
            estimates = self.network.estimates(measurement, self.psf if psf is None else psf)  # type: ignore[operator]
            unit = self.network.unit(estimates)  # type: ignore[operator]
            self.kept[row] = estimates[0].half(), unit[0], scene[0].half()
        return self.kept[row]
