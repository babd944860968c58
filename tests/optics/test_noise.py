"""The estimate of a measurement's noise, and its median."""

import math

import pytest
import torch

from mwdn.optics.noise import median, noise_level


@pytest.mark.parametrize("count", [1, 2, 7, 134])
@pytest.mark.parametrize("inference", [False, True])
def test_median_is_torchs(count, inference):
    with torch.inference_mode(inference):
        values = torch.randn(2, 3, 16, count)
        assert torch.equal(median(values), values.median(-1).values)


def test_median_with_nan_is_nan():
    with torch.inference_mode():
        values = torch.tensor([[1.0, math.nan, 2.0], [3.0, 1.0, 2.0]])
        torch.testing.assert_close(median(values), torch.tensor([math.nan, 2.0]), equal_nan=True)


def test_median_has_torchs_gradient():
    values = torch.randn(3, 9, requires_grad=True)
    (gradient,) = torch.autograd.grad(median(values).sum(), values)
    assert gradient.sum() == 3
    assert gradient.count_nonzero() == 3


@pytest.mark.parametrize("sigma", [0.01, 0.1])
def test_white_noise_is_measured(sigma):
    ramp = torch.linspace(0, 1, 200).expand(1, 3, 200, 200)
    measured = noise_level(ramp + sigma * torch.randn(1, 3, 200, 200))
    assert measured.flatten().tolist() == pytest.approx([sigma] * 3, rel=0.03)
