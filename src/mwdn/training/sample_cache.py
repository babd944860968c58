"""A cache of samples with what a network computes of them before its learned part."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mwdn.data.random import seeded
from mwdn.data.simulated import Samples, full_precision
from mwdn.errors import ParameterError
from mwdn.networks.network import FixedFront
from mwdn.training.sample_files import Sample, SampleFiles
from mwdn.types import Image, Scene

MEASURED = 20
"""Largest number of pairs that measure distortion and shading."""

Measure = Callable[[Sequence[Tensor], Sequence[Tensor], int], Tensor]
"""From reconstructions and scenes, (C, H, W) each, and an order to coefficients, as `measure_shading` does."""

Progress = Callable[[int, int], None]
"""Called with the number of samples that are done, and how many there are."""


class SampleCache:
    """A finite number of samples, used repeatedly, each time mirrored or transposed another way.

    `fill` computes samples before training and keeps them on the disk; a sample that it did not compute is computed
    when it is first needed. A resumed run continues exactly.

    Args:
        pairs: source of the samples; its numbers 0 to ``size`` - 1 are used.
        size: number of samples to keep, in half precision in memory: 4 MB each at 320 x 320. A multiple of ``batch``.
        batch: samples per step. Each place in a batch has its own samples, so that a process never computes those of
            another.
        crop: side of the square that is cut out at random each time; 0 for the whole frame.
        seed: of the samples' order.

    Raises:
        ParameterError: ``size`` is no multiple of ``batch``.
    """

    def __init__(self, pairs: Samples, *, size: int, batch: int, crop: int, seed: int) -> None:
        if size % batch:
            raise ParameterError(f"`pool` ({size}) must be a multiple of `batch` ({batch}).")
        self.pairs, self.size, self.batch_size, self.crop, self.seed = pairs, size, batch, crop, seed
        self.samples: dict[int, Sample] = {}

    def front(self, network: nn.Module) -> FixedFront[Any]:
        """The network, whose part before its learned one is cached.

        Raises:
            ParameterError: it learns from its first layer on.
        """
        if not isinstance(network, FixedFront):
            raise ParameterError(
                f"`pool` ({self.size}) caches what a network computes before its learned part; this one learns from "
                "its first layer on. Set `pool = 0` and `crop = 0`: `--schedule.pool 0 --schedule.crop 0`."
            )
        return network

    @full_precision
    def fill(self, network: FixedFront[Any], numbers: Iterable[int], files: SampleFiles, progress: Progress) -> None:
        """Compute the samples of these numbers; read those that an interrupted run left on the disk.

        Args:
            network: computes the estimates.
            numbers: of samples, of any epochs.
            files: to keep the samples in, if the disk has room for them.
            progress: called before the first sample that is computed and after each.

        Raises:
            KeyboardInterrupt: Ctrl-C; its message says how many samples are done.
            ParameterError: the disk became full.
        """
        rows = dict.fromkeys(self._row(*divmod(number, self.size)) for number in numbers)
        device = next(network.parameters()).device
        for row in rows.keys() - self.samples.keys():
            if sample := files.read(row):
                self.samples[row] = Sample(*(value.to(device) for value in sample))
        missing = [row for row in rows if row not in self.samples]
        first, kept = len(rows) - len(missing), True
        for done, row in enumerate(missing, first):
            try:
                progress(done, len(rows))
                sample = self._cached(network, row)
                kept = kept and (done > first or files.fits(len(missing) * sum(part.nbytes for part in sample)))
                if kept:
                    files.write(row, sample)
            except KeyboardInterrupt as interrupt:
                message = f"Interrupted after {done:,} of {len(rows):,} samples. The same command resumes."
                raise KeyboardInterrupt(message) from interrupt
        progress(len(rows), len(rows))

    @full_precision
    def reconstruct_whole(self, network: nn.Module, numbers: range | list[int]) -> Image:
        """Reconstructions in the order of the numbers, neither mirrored nor cropped: for validation."""
        front = self.front(network)
        samples = [self._cached(front, number % self.size) for number in numbers]
        estimates, units, _ = (torch.stack(part).float() for part in zip(*samples, strict=True))
        return front.as_recorded(front.correct(estimates, units))

    @torch.no_grad()
    def measured(self, measure: Measure, network: nn.Module, order: int) -> Tensor:
        """Apply a measure to the reconstructions and scenes of the samples computed so far, `MEASURED` at most.

        Measures compare halves of the pairs, so a pair that is in several samples of the last batch counts once.
        """
        scenes: dict[int, Scene] = {}
        for row in sorted(self.samples)[:: -(-len(self.samples) // MEASURED)]:
            scene = self.samples[row].scene
            if not any(torch.equal(scene, other) for other in scenes.values()):
                scenes[row] = scene
        pictures = [self.reconstruct_whole(network, [row])[0] for row in scenes]
        return measure(pictures, list(scenes.values()), order)

    def reconstruct(self, network: nn.Module, numbers: range | list[int]) -> tuple[Image, Scene]:
        """Reconstructions of the samples of these numbers, and their scenes."""
        front = self.front(network)
        estimates, unit, scene = self.batch(front, numbers)
        return front.correct(estimates, unit), scene

    @full_precision
    def batch(self, network: FixedFront[Any], numbers: range | list[int]) -> tuple[Tensor, Tensor, Scene]:
        """Estimates, units and scenes of the samples of these numbers, which may belong to any epoch."""
        samples = [self._sample(network, number) for number in numbers]
        estimates, units, scenes = (torch.stack(part).float() for part in zip(*samples, strict=True))
        return estimates, units, scenes

    def _sample(self, network: FixedFront[Any], number: int) -> tuple[Tensor, Tensor, Tensor]:
        """A cached sample, mirrored, transposed and cropped."""
        epoch, place = divmod(number, self.size)
        estimates, unit, scene = self._cached(network, self._row(epoch, place))
        scene = network.as_reconstructed(scene[None])[0]
        # The eight symmetries of a square in turn; a frame that is not square is never transposed.
        symmetry = epoch + place
        axes = [axis for axis, bit in ((-1, 1), (-2, 2)) if symmetry & bit]
        estimates, scene = estimates.flip(axes), scene.flip(axes)
        if symmetry & 4 and scene.shape[-2] == scene.shape[-1]:
            estimates, scene = estimates.transpose(-2, -1), scene.transpose(-2, -1)
        if self.crop:
            window = self._window(number, scene)
            estimates, scene = estimates[window], scene[window]
        return estimates, unit, scene

    def _row(self, epoch: int, place: int) -> int:
        """The sample at a place of an epoch: each slot of the batch goes through its own samples in random order."""
        step, slot = divmod(place, self.batch_size)
        generator = seeded((self.seed * 1_000_003 + epoch) * self.batch_size + slot)
        order = torch.randperm(self.size // self.batch_size, generator=generator)
        return int(order[step]) * self.batch_size + slot

    def _window(self, number: int, scene: Tensor) -> tuple[Any, ...]:
        """Index of a random square of the frame."""
        rows, columns = scene.shape[-2:]
        height, width = min(self.crop, rows), min(self.crop, columns)
        down, right = torch.rand(2, generator=seeded(self.seed * 1_000_003 + number + 1))
        top, left = int(down * (rows - height + 1)), int(right * (columns - width + 1))
        return ..., slice(top, top + height), slice(left, left + width)

    @torch.no_grad()
    def _cached(self, network: FixedFront[Any], row: int) -> Sample:
        if row not in self.samples:
            measurement, scene, psf = self.pairs.batch([row])
            estimates = network.estimates(measurement, psf)
            unit = network.unit(estimates)[0]
            if scene.shape[1] == 1 < network.channels:  # a grey camera: equal colours
                scene = scene.expand(-1, network.channels, -1, -1)
            self.samples[row] = Sample(estimates[0].half().contiguous(), unit, scene[0].half().contiguous())
        return self.samples[row]
