"""The denoiser: its maps against convolutions of stride 2, and what having no bias promises."""

import pytest
import torch
from torch.nn import functional as F

from mwdn.networks import DENOISERS, build


@pytest.fixture
def network():
    torch.manual_seed(0)
    return build("drunet", widths=(4, 6, 8), blocks=1).eval()


def test_size_of_the_bundled_one():
    assert sum(parameter.numel() for parameter in build("drunet").parameters()) == 1_793_920
    assert all(parameter.ndim == 4 for parameter in build("drunet").parameters())  # weights alone, no bias


@pytest.mark.parametrize("size", [(32, 48), (33, 47), (5, 3)])
def test_the_picture_keeps_its_size(network, size, generator):
    picture = torch.rand(2, 3, *size, generator=generator)
    assert network(picture, torch.full((2, 1, 1, 1), 0.1)).shape == picture.shape
    torch.testing.assert_close(
        network(picture, torch.full((1, 1, 1, 1), 0.1)), network(picture, torch.full((2, 1, 1, 1), 0.1))
    )


def test_brighter_light_and_noise_give_a_brighter_picture(network, generator):
    picture, level = torch.rand(1, 3, 16, 16, generator=generator), torch.full((1, 1, 1, 1), 0.1)
    torch.testing.assert_close(network(3 * picture, 3 * level), 3 * network(picture, level))


def test_each_sample_has_its_own_level(network, generator):
    pictures, levels = torch.rand(2, 3, 16, 16, generator=generator), torch.tensor([0.02, 0.2]).view(2, 1, 1, 1)
    together = network(pictures, levels)
    for i in range(2):
        torch.testing.assert_close(together[i : i + 1], network(pictures[i : i + 1], levels[i : i + 1]))
    assert not torch.allclose(network(pictures[:1], levels[1:]), together[:1], atol=1e-4)


def test_halving_and_doubling_are_convolutions_of_stride_2(network, generator):
    """The reference has those; here they are 1 x 1 convolutions after pixel unshuffling."""
    features = torch.randn(1, 4, 8, 6, generator=generator)
    down, up = network.down[0], network.up[0]
    strided = F.conv2d(features, down.weight.reshape(6, 4, 2, 2), stride=2)
    torch.testing.assert_close(down(F.pixel_unshuffle(features, 2)), strided)
    coarse = torch.randn(1, 6, 4, 3, generator=generator)
    transposed = F.conv_transpose2d(coarse, up.weight.reshape(4, 2, 2, 6).permute(3, 0, 1, 2), stride=2)
    torch.testing.assert_close(F.pixel_shuffle(up(coarse), 2), transposed)


def test_denoisers_are_built_by_name():
    assert set(DENOISERS) == {"drunet"}


def test_another_condition_without_weight_changes_nothing(generator):
    """Weights of a denoiser that is told its level alone, in one that is told more."""
    from mwdn.weights.growth import grown

    one, two = (build("drunet", widths=(4, 6, 8), blocks=1, conditions=count).eval() for count in (1, 2))
    two.load_state_dict(grown(one.state_dict(), two))
    picture, level = torch.rand(2, 3, 24, 20, generator=generator), torch.tensor([0.1, 0.2]).reshape(2, 1, 1, 1)
    with torch.no_grad():
        torch.testing.assert_close(two(picture, torch.cat([level, 3 * level], 1)), one(picture, level))
