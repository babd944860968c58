"""VGG-16's features, with random weights under torchvision's keys."""

import pytest
import torch
from torch.nn import functional as F

from mwdn.errors import CheckpointError, ShapeError
from mwdn.evaluation.distances import vgg_mse
from mwdn.evaluation.vgg import Vgg16, load_vgg16
from mwdn.training.losses import Loss

# Number of each convolution among torchvision's layers; None where the picture is halved.
LAYERS = [0, 2, None, 5, 7, None, 10, 12, 14, None, 17, 19, 21]


@pytest.fixture(scope="module")
def weights():
    torch.manual_seed(3)
    return Vgg16().state_dict()


def features(weights, x):
    """By the numbers of the layers: relu2_2 follows layer 7, relu4_3 layer 21."""
    for layer in LAYERS:
        if layer is None:
            x = F.max_pool2d(x, 2)
        else:
            x = F.conv2d(x, weights[f"features.{layer}.weight"], weights[f"features.{layer}.bias"], padding=1).relu()
        if layer == 7:
            middle = x
    return middle, x


@torch.no_grad()
def test_vgg_mse_is_eq_3_with_vgg(tmp_path, weights, generator, monkeypatch):
    unused = {"features.24.weight": torch.ones(3), "classifier.0.weight": torch.ones(2)}  # as in the public file
    torch.save(weights | unused, tmp_path / "v.pth")
    monkeypatch.setenv("MWDN_VGG16", str(tmp_path / "v.pth"))
    a, b = (torch.rand(2, 3, 24, 17, generator=generator) for _ in range(2))
    expected = sum(
        (x - y).square().mean((1, 2, 3)) for x, y in zip(features(weights, a), features(weights, b), strict=True)
    )
    network = load_vgg16()
    torch.testing.assert_close(vgg_mse(a, b, network), expected)
    torch.testing.assert_close(Loss({"vgg_mse": 2.0})(a, b)[0], 2 * expected.mean())
    assert not any(parameter.requires_grad for parameter in network.parameters())
    with pytest.raises(ShapeError, match="VGG-16"):
        vgg_mse(a[..., :7], b[..., :7], network)


def test_other_weights_are_refused(tmp_path):
    torch.save({"features.0.weight": torch.ones(2)}, tmp_path / "v.pth")
    with pytest.raises(CheckpointError, match="does not hold the weights of `Vgg16`"):
        load_vgg16(tmp_path / "v.pth")
