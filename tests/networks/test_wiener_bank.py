"""What the U-Net behind the bank may change of the estimates."""

import pytest
import torch

from mwdn.errors import ParameterError
from mwdn.networks import build


@pytest.mark.parametrize("fold", [1, 2, 4])
@pytest.mark.parametrize("size", [(160, 144), (151, 137)])
def test_neither_light_nor_pattern_of_the_folded_blocks_is_added(generator, fold, size):
    """A U-Net that answers with a number of its own at each place in the blocks."""
    network = build("wiener-bank", width=2, fold=fold, block=8).eval()
    with torch.no_grad():
        network.decoder.head.weight.zero_()
        network.decoder.head.bias.copy_(torch.rand(3 * fold**2, generator=generator))
    estimates = torch.rand(1, 15, *size, generator=generator)
    with torch.no_grad():
        corrected = network.correct(estimates, network.unit(estimates))
    torch.testing.assert_close(corrected, estimates[:, :3])


def test_the_mean_light_of_blocks_stays(generator):
    network = build("wiener-bank", width=2, block=8).eval()
    with torch.no_grad():
        network.decoder.head.weight.mul_(10)
        estimates = torch.rand(1, 15, 160, 144, generator=generator)
        change = network.correct(estimates, network.unit(estimates)) - estimates[:, :3]
    blocks = torch.nn.functional.avg_pool2d(change, 16)
    assert blocks.abs().max() < 0.2 * change.abs().max()


@pytest.mark.parametrize("gain", [1e-8, 1e8])
def test_gain_does_not_matter(generator, gain):
    network = build("wiener-bank", width=2, block=8).eval()
    psf, measurement = torch.rand(1, 3, 64, 72, generator=generator) ** 8, torch.rand(1, 3, 64, 72, generator=generator)
    with torch.no_grad():
        expected, result = network(measurement, psf), network(gain * measurement, psf) / gain
    torch.testing.assert_close(result, expected, rtol=1e-3, atol=1e-3 * float(expected.max()))


@pytest.mark.parametrize("options", [{"rounds": -1}, {"fold": 0}, {"width": 0}])
def test_numbers_that_are_no_counts(options):
    with pytest.raises(ParameterError, match=f"`{next(iter(options))}` .* must be .*at least"):
        build("wiener-bank", **options)
