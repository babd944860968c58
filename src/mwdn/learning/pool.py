"""Samples that are kept: what a network computes of them before its learned part is computed once."""

import torch
from torch import Tensor, nn

from mwdn.data.simulated import Samples
from mwdn.errors import ParameterError
from mwdn.types import Psf


class Pool:
    """A finite number of samples, used again and again, each time mirrored or turned another way.

    For networks whose forward pass is ``correct(estimates(measurement, psf))`` with nothing to learn in ``estimates``.
    A sample enters when it is first needed, so a run begins at once and a stopped one goes on as it would have.

    Args:
        pairs: where the samples come from; its numbers 0 to ``size`` - 1 are used.
        network: computes the estimates.
        psf: of the camera, where the pairs have none of their own.
        size: how many samples are kept, as half precision in memory: 4 MB each at 320 x 320. A multiple of ``batch``.
        batch: samples of a step. Each place in a batch has samples of its own, so that each process keeps its own.
        seed: of their order.

    Raises:
        ParameterError: the network learns in its estimates, or has none; or the size is no multiple of the batch.
    """

    def __init__(self, pairs: Samples, network: nn.Module, psf: Psf, *, size: int, batch: int, seed: int) -> None:
        if size % batch:
            raise ParameterError(f"`pool` ({size}) must be a multiple of `batch` ({batch}).")
        if not (hasattr(network, "estimates") and hasattr(network, "correct")):
            raise ParameterError(
                f"`pool` ({size}) keeps what a network computes before it learns; {type(network).__name__} learns from "
                "the first step on. Set `pool = 0`."
            )
        self.pairs, self.network, self.psf = pairs, network, psf
        self.size, self.together, self.seed = size, batch, seed
        self.kept: dict[int, tuple[Tensor, Tensor]] = {}

    def batch(self, numbers: range | list[int]) -> tuple[Tensor, Tensor]:
        """Estimates and scenes of the samples of these numbers, which may be of any epoch."""
        with torch.autocast(self.psf.device.type, enabled=False):
            samples = [self._turned(number) for number in numbers]
            estimates, scenes = zip(*samples, strict=True)
            return torch.stack(estimates).float(), torch.stack(scenes).float()

    def _turned(self, number: int) -> tuple[Tensor, Tensor]:
        epoch, place = divmod(number, self.size)
        step, slot = divmod(place, self.together)
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + epoch) * self.together + slot)
        order = torch.randperm(self.size // self.together, generator=generator)
        estimates, scene = self._sample(int(order[step]) * self.together + slot)
        # The mirror images of a square; a frame of two lengths is not turned on its side.
        way = epoch + place
        axes = [axis for axis, bit in ((-1, 1), (-2, 2)) if way & bit]
        estimates, scene = estimates.flip(axes), scene.flip(axes)
        if way & 4 and scene.shape[-2] == scene.shape[-1]:
            estimates, scene = estimates.transpose(-2, -1), scene.transpose(-2, -1)
        return estimates, scene

    @torch.no_grad()
    def _sample(self, row: int) -> tuple[Tensor, Tensor]:
        if row not in self.kept:
            measurement, scene, psf = self.pairs.batch([row])
            estimates = self.network.estimates(measurement, self.psf if psf is None else psf)  # type: ignore[operator]
            self.kept[row] = estimates[0].half(), scene[0].half()
        return self.kept[row]
