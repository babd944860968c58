"""Activation checkpointing changes neither gradients nor BatchNorm statistics."""

import copy

import pytest
import torch
from torch import nn

from mwdn.errors import ParameterError
from mwdn.networks import build
from mwdn.networks.activation_checkpointing import CheckpointedModule, checkpoint_activations
from mwdn.training.batch_norm import GlobalBatchNorm2d


def learned_once(network, measurement, psf):
    """Gradients of one step, BatchNorm statistics after it, and the count of numbers saved for the backward pass."""
    kept = {}

    def count(tensor):
        kept[tensor.data_ptr()] = tensor.numel()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        result = network(measurement, psf)
    result.square().sum().backward()
    gradients = {name: parameter.grad for name, parameter in network.named_parameters()}
    return gradients, dict(network.named_buffers()), sum(kept.values())


@pytest.mark.parametrize("synchronised", [False, True])
@pytest.mark.parametrize("name", ["unet", "wiener-unet", "mwdn", "mwdn-cpsf", "wiener-bank"])
def test_gradients_and_statistics_are_the_same(name, synchronised, generator):
    network = build(name, width=4).train()
    for module in network.modules():
        if synchronised and isinstance(module, nn.BatchNorm2d):
            module.__class__ = GlobalBatchNorm2d
    psf = torch.rand(1, 3, 17, 31, generator=generator) ** 8
    measurement = torch.rand(2, 3, 17, 31, generator=generator)
    other = copy.deepcopy(network)
    checkpoint_activations(other)
    gradients, statistics, kept = learned_once(network, measurement, psf)
    same_gradients, same_statistics, kept_less = learned_once(other, measurement, psf)
    for expected, result in ((gradients, same_gradients), (statistics, same_statistics)):
        assert expected.keys() == result.keys()
        for key in expected:
            torch.testing.assert_close(result[key], expected[key], msg=lambda text, key=key: f"{key}: {text}")
    counts = [value for key, value in statistics.items() if key.endswith("num_batches_tracked")]
    assert counts
    assert set(map(int, counts)) == {1}
    assert kept_less < 0.7 * kept


def test_settings_of_batchnorm_come_back(generator):
    network = build("unet", width=8).train()
    checkpoint_activations(network)
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    buffers = [norm.num_batches_tracked for norm in norms]
    measurement = torch.rand(2, 3, 16, 16, generator=generator)
    for count in (1, 2):
        network(measurement, measurement[:1]).sum().backward()
        assert {norm.momentum for norm in norms} == {0.1}
        assert all(norm.num_batches_tracked is buffer for norm, buffer in zip(norms, buffers, strict=True))
        assert set(map(int, buffers)) == {count}


def test_network_without_scales():
    with pytest.raises(ParameterError, match=r"`checkpointing` needs .* LeAdmm"):
        checkpoint_activations(build("le-admm"))
    assert not any(isinstance(module, CheckpointedModule) for module in build("le-admm").modules())
