"""The gradient that a graph leaves is that of the loss; `tests/test_gpu.py` replays real graphs."""

import copy

import pytest
import torch

from mwdn.data.simulated import Batch, Samples
from mwdn.networks import build
from mwdn.training import gradient as module
from mwdn.training.gradient import Gradient
from mwdn.training.losses import Loss
from mwdn.training.recipe import Schedule
from mwdn.training.tasks import SupervisedTask


class Given(Samples):
    """Two batches of different shapes, by number."""

    name = "given"

    def __init__(self, generator):
        self.batches = [
            Batch(*torch.rand(2, 2, 3, size, size, generator=generator), torch.full((1, 3, size, size), size**-2.0))
            for size in (32, 48)
        ]

    def batch(self, numbers):
        return self.batches[numbers[0]]


class Rehearsed:
    """Stands for a `CudaGraph` that could not be recorded: its warm-up has run three times."""

    graph = None

    def __init__(self, calculate, *inputs):
        self.calculate = calculate
        for _ in range(3):
            calculate(*inputs)

    def __call__(self, *inputs):
        return self.calculate(*inputs)


@pytest.fixture
def gradients(generator, monkeypatch):
    """Of two equal networks: as written, and with a graph for each shape."""
    monkeypatch.setattr(module, "CudaGraph", Rehearsed)
    network, task = build("mwdn", width=4), SupervisedTask(Given(generator))
    both = []
    for each in (network, copy.deepcopy(network)):
        schedule = Schedule(batch=2, bfloat16=False)
        both.append(Gradient(each, task, Loss({"mse": 1.0, "ssim": 0.1}), schedule, torch.device("cpu")))
    both[1].is_recorded = True
    return both


def test_a_graph_leaves_the_same_gradient_and_statistics(gradients):
    for number in (0, 1, 0):
        plain, recorded = (each(range(number, number + 2)) for each in gradients)
        assert list(plain) == list(recorded) == ["loss", "mse", "ssim"]
        torch.testing.assert_close(recorded, plain, rtol=0, atol=0)
        for one, other in zip(*(each.network.parameters() for each in gradients), strict=True):
            torch.testing.assert_close(other.grad, one.grad, rtol=0, atol=0)
        for one, other in zip(*(each.network.buffers() for each in gradients), strict=True):
            torch.testing.assert_close(other, one, rtol=0, atol=0)
    assert len(gradients[1].graphs) == 2


def test_other_weights_of_the_loss_are_recorded_anew(gradients):
    recorded = gradients[1]
    first = recorded(range(2))["loss"]
    recorded.distance.weights = {"mse": 1.0, "ssim": 1.0}
    assert recorded(range(2))["loss"] > first
    assert len(recorded.graphs) == 2
