"""Fused networks in half precision."""

import pytest
import torch

from mwdn.inference.fusion import Float32Layer, fuse
from mwdn.networks import build


@pytest.mark.parametrize("name", ["flatnet", "svdeconv", "ifin"])
def test_group_norm_never_sees_float16(name, generator):
    """On a GPU torch refuses features in float16 with weights in float32; on the CPU it takes them."""
    network = build(name, width=16).eval()
    psf, measurement = torch.rand(1, 3, 64, 64, generator=generator) ** 8, torch.rand(1, 3, 64, 64, generator=generator)
    with torch.no_grad():
        expected = network(measurement, psf)
        fused = fuse(network, torch.float16)
        result = fused(measurement, psf)
    wrapped = [layer.layer for layer in fused.modules() if isinstance(layer, Float32Layer)]
    norms = [layer for layer in fused.modules() if isinstance(layer, torch.nn.GroupNorm)]
    assert norms
    assert all(any(norm is layer for layer in wrapped) for norm in norms)
    assert (result - expected).abs().max() < 0.01 * expected.abs().max()
