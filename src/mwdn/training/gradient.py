"""The gradient of a batch. On a GPU forward and backward pass are recorded once as a CUDA graph and replayed."""

from collections.abc import Callable, Hashable

import torch
from torch import Tensor, nn

from mwdn.data.simulated import Batch
from mwdn.inference.cuda_graph import CudaGraph
from mwdn.networks.activation_checkpointing import batch_norms
from mwdn.runtime import distributed
from mwdn.runtime.devices import has_bfloat16
from mwdn.training.losses import Loss
from mwdn.training.recipe import Schedule
from mwdn.training.tasks import SupervisedTask, Task


class Gradient:
    """Computes the loss of samples, and leaves its gradient in ``grad`` of the network's parameters.

    A step of a small network is thousands of kernels, which take Python longer to launch than a GPU to compute. So on a
    GPU the loss of a `SupervisedTask` without a cache is recorded, once for each shape of its batches.

    Args:
        network: in training mode when it is called.
        task: what to learn, and from which samples.
        distance: the loss. A graph is recorded anew when its weights change.
        schedule: of the training.
        device: where the network and the samples are.
    """

    def __init__(
        self, network: nn.Module, task: Task, distance: Loss, schedule: Schedule, device: torch.device
    ) -> None:
        self.network, self.task, self.distance, self.device = network, task, distance, device
        self.bfloat16 = schedule.bfloat16 and has_bfloat16(device)
        self.norms = batch_norms(network) if schedule.fixed_norms else []
        is_alone = device.type == "cuda" and distributed.world_size() == 1 and not schedule.checkpointing
        self.is_recorded = is_alone and isinstance(task, SupervisedTask) and task.cache is None
        self.graphs: dict[Hashable, tuple[CudaGraph, list[Tensor | None]]] = {}
        self.names: tuple[str, ...] = ()

    def __call__(self, numbers: range, weight: float = 1.0) -> dict[str, Tensor]:
        """Compute the gradient of the samples of these numbers.

        Args:
            numbers: of the samples.
            weight: factor of the loss in the gradient.

        Returns:
            The loss, as "loss", and its parts, without ``weight``, scalars without gradient.
        """
        self.network.train()
        for norm in self.norms:
            norm.eval()
        if self.is_recorded:
            values = self._graph(numbers)
        else:
            values = self._run(lambda: self.task.loss(self.network, self.distance, numbers), weight)
        return dict(zip(self.names, values, strict=True))

    def _graph(self, numbers: range) -> Tensor:
        """Loss and parts from a graph, which is recorded for the first batch of its shapes."""
        task = self.task
        assert isinstance(task, SupervisedTask)
        batch = task.batch(numbers)

        def calculate(*parts: Tensor) -> Tensor:
            return self._run(lambda: task.batch_loss(self.network, self.distance, Batch(*parts)))

        key = (*(part.shape for part in batch), *self.distance.weights.items())
        if key not in self.graphs:
            buffers = list(self.network.buffers())
            before = [buffer.clone() for buffer in buffers]
            graph = CudaGraph(calculate, *batch)
            self.graphs[key] = graph, [parameter.grad for parameter in self.network.parameters()]
            for buffer, value in zip(buffers, before, strict=True):
                buffer.copy_(value)  # BatchNorm has counted the warm-up
        graph, gradients = self.graphs[key]
        values = graph(*batch)
        if graph.graph is not None:
            for parameter, gradient in zip(self.network.parameters(), gradients, strict=True):
                parameter.grad = gradient  # each graph has memory of its own
        return values

    def _run(self, compute: Callable[[], tuple[Tensor, dict[str, Tensor]]], weight: float = 1.0) -> Tensor:
        """Loss and parts, with the gradient in new memory, which each replay of a graph writes again."""
        self.network.zero_grad(set_to_none=True)
        # A graph must cast the weights itself: a replay does not fill autocast's cache.
        cached = not self.is_recorded
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16, cache_enabled=cached):
            loss, parts = compute()
        torch.autograd.backward(weight * loss)
        self.names = "loss", *parts
        return torch.stack([loss.detach(), *parts.values()])
