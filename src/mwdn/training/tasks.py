"""Training tasks: a loss of numbered samples. Here from pairs; `selfsupervised` has the task without scenes."""

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from mwdn.data.recorded import RecordedPairs
from mwdn.data.simulated import Batch, NumberedSamples, Samples
from mwdn.evaluation.metrics import best_gain
from mwdn.networks import Network
from mwdn.solvers import align
from mwdn.training.losses import Loss
from mwdn.training.recipe import Schedule
from mwdn.training.sample_cache import SampleCache
from mwdn.types import Image, Measurement, Psf, Scene


class Scores(NamedTuple):
    """Validation of a batch.

    Args:
        psnr: (B,), in dB.
        loss: mean over the batch.
        pictures: three (B, C, H, W): measurement, reconstruction, and what to compare that with.
    """

    psnr: Tensor
    loss: float
    pictures: tuple[Tensor, Tensor, Tensor]


@runtime_checkable
class Task(Protocol):
    """A task for the `mwdn.training.trainer.Trainer`. Samples are numbered without end."""

    columns: ClassVar[tuple[str, str]]
    """Titles on the contact sheet, left and right of the reconstruction."""

    @property
    def cache(self) -> SampleCache | None:
        """Samples to compute before training, if they are cached."""

    @property
    def samples(self) -> NumberedSamples:
        """The samples to learn from."""

    def check(self, network: nn.Module) -> None:
        """Raise an `MwdnError` if the network cannot learn the task."""

    def loss(self, network: nn.Module, distance: Loss, numbers: range) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the samples of these numbers, and its parts without their weights."""

    def score(self, network: nn.Module, distance: Loss, numbers: range) -> Scores:
        """Validate a network in evaluation mode on the samples of these numbers."""


@dataclass(frozen=True, eq=False)
class SupervisedTask:
    """Learn from pairs: the loss is the distance of reconstruction and scene.

    Training does not align the PSF, validation does if the network is used with an aligned one (``network.align``).

    Args:
        samples: pairs of measurement and scene, and their PSFs.
        cache: of these pairs, to train or validate on it instead.
        best_gain: scenes have units of their own: compare after the gain and offset of each colour that fit best.
        stored_psf: (1, C, H, W), PSF for a network that takes it as stored, instead of that of the samples.
    """

    samples: Samples
    cache: SampleCache | None = None
    best_gain: bool = False
    stored_psf: Psf | None = None

    columns: ClassVar[tuple[str, str]] = "measurement", "scene"

    def check(self, network: nn.Module) -> None:
        """Check that the network can use the cache."""
        if self.cache is not None:
            self.cache.front(network)

    def loss(self, network: nn.Module, distance: Loss, numbers: range) -> tuple[Tensor, dict[str, Tensor]]:
        """Distance of the reconstructions and the scenes of these numbers, and its parts."""
        if self.cache is None:
            return self.batch_loss(network, distance, self.batch(numbers))
        reconstruction, scene = self.cache.reconstruct(network, numbers)
        return distance(self._in_units(reconstruction.float(), scene), scene)

    def batch_loss(self, network: nn.Module, distance: Loss, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The same for a batch."""
        measurement, scene, psf = batch
        reconstruction = network(measurement.contiguous(memory_format=torch.channels_last), psf)
        if isinstance(network, Network):
            scene = network.as_reconstructed(scene)
        return distance(self._in_units(reconstruction.float(), scene), scene)

    def score(self, network: nn.Module, distance: Loss, numbers: range) -> Scores:
        """PSNR and loss of the reconstructions; the loss always has its initial weights."""
        measurement, scene, psf = self.batch(numbers)
        if self.cache is None:
            reconstruction = reconstruct_aligned(network, measurement, psf)
        else:
            reconstruction = self.cache.reconstruct_whole(network, numbers)
        scene = scene.expand_as(reconstruction)  # of a grey camera: equal colours
        reconstruction = self._in_units(reconstruction, scene)
        psnr = -10 * torch.log10((reconstruction.clamp(0, 1) - scene).square().mean((1, 2, 3)))
        parts = distance(reconstruction, scene)[1]
        loss = sum(weight * parts[name].item() for name, weight in distance.initial_weights.items())
        return Scores(psnr, loss, (measurement, reconstruction, scene))

    def batch(self, numbers: range) -> Batch:
        """Measurements, scenes and PSFs of these numbers."""
        batch = self.samples.batch(numbers)
        return batch if self.stored_psf is None else batch._replace(psf=self.stored_psf)

    def _in_units(self, reconstruction: Image, scene: Scene) -> Image:
        return best_gain(reconstruction, scene, axes=(2, 3)) if self.best_gain else reconstruction


def supervised_task(pairs: Samples, schedule: Schedule) -> SupervisedTask:
    """The task of learning from pairs: cached as the schedule says, or else prefetched."""
    if schedule.pool == 0:
        return SupervisedTask(pairs.prefetched(schedule.batch))
    size, batch, crop, seed = schedule.pool, schedule.batch, schedule.crop, schedule.seed
    return SupervisedTask(pairs, SampleCache(pairs, size=size, batch=batch, crop=crop, seed=seed))


def with_stored_psf(task: Task, psf: Psf | None) -> Task:
    """The task of learning from pairs, for a network that takes this PSF as stored; ``None`` changes nothing."""
    return replace(task, stored_psf=psf) if isinstance(task, SupervisedTask) else task


def pair_tasks(
    training: Samples, validation: RecordedPairs, schedule: Schedule, *, best_gain: bool = False
) -> tuple[SupervisedTask, SupervisedTask]:
    """Tasks of training and validation on pairs.

    Aligned pairs are few, so the cache holds all of them, also those of the validation: each is aligned only once.

    Args:
        training: at most ``pool`` are used, if they are cached. The cache of aligned ones is a multiple of the batch:
            the last pairs may be twice in it.
        validation: as many as the schedule says.
        schedule: has the batch and the size of the cache.
        best_gain: see `SupervisedTask`.
    """
    if not (schedule.pool and isinstance(training, RecordedPairs) and training.aligned):
        task = replace(supervised_task(training, schedule), best_gain=best_gain)
        return task, SupervisedTask(validation, best_gain=best_gain)
    batch, crop, seed = schedule.batch, schedule.crop, schedule.seed
    size = -(-min(schedule.pool, len(training)) // batch) * batch
    cache = SampleCache(training, size=size, batch=batch, crop=crop, seed=seed)
    held_out = SampleCache(validation, size=len(validation), batch=1, crop=0, seed=seed)
    return SupervisedTask(training, cache, best_gain), SupervisedTask(validation, held_out, best_gain)


def reconstruct_aligned(network: nn.Module, measurement: Measurement, psf: Psf) -> Scene:
    """Reconstruct as `mwdn.Reconstructor` does: the PSF aligned if ``network.align``, the scene as recorded."""
    if not isinstance(network, Network):
        return network(measurement, psf)
    if network.align:
        psf = align(measurement, psf).move(psf)
    return network.as_recorded(network(measurement, psf))
