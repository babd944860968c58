"""Cached samples: computed once, used again in each epoch, mirrored, and the same after a resume."""

import pytest
import torch

from mwdn.data.simulated import Batch, Samples
from mwdn.errors import ParameterError
from mwdn.networks import build
from mwdn.networks.network import FixedFront
from mwdn.training.sample_cache import SampleCache


class Counted(Samples):
    """Sample n has the value n everywhere but in one corner, 2 n; records the requested numbers."""

    name = "counted"

    def __init__(self, size=(4, 4)):
        self.size, self.asked = size, []

    def batch(self, numbers):
        self.asked += numbers
        picture = torch.stack([torch.full((1, *self.size), float(number)) for number in numbers])
        picture[..., 0, 0] *= 2
        return Batch(picture, picture + 100, torch.ones(1, 1, *self.size))


class Same(FixedFront):
    def estimates(self, measurement, psf):
        return measurement

    def unit(self, estimates):
        return estimates.amax((1, 2, 3), keepdim=True)

    def correct(self, estimates, unit):
        return estimates


def cached(pairs, size=6, batch=2, crop=0):
    """A function of numbers: the batch of a cache."""
    cache = SampleCache(pairs, size=size, batch=batch, crop=crop, seed=0)
    return lambda numbers: cache.batch(Same(), numbers)


def test_each_epoch_has_each_sample_once_and_computes_none_twice():
    pairs = Counted()
    batch = cached(pairs)
    for epoch in range(4):
        estimates, units, scenes = batch(range(6 * epoch, 6 * epoch + 6))
        assert sorted(estimates.amin((1, 2, 3)).tolist()) == [0, 1, 2, 3, 4, 5]
        torch.testing.assert_close(scenes, estimates + 100)
        torch.testing.assert_close(units, estimates.amax((1, 2, 3), keepdim=True))
    assert sorted(pairs.asked) == [0, 1, 2, 3, 4, 5]


def test_a_sample_comes_in_all_symmetries_of_a_square():
    marked = Counted()
    marked.batch = lambda numbers: Batch(*3 * (torch.arange(16.0).view(1, 1, 4, 4),))
    batch = cached(marked, size=1, batch=1)
    ways = {tuple(batch([number])[0].flatten().tolist()) for number in range(8)}
    assert len(ways) == 8


def test_a_frame_that_is_not_square_keeps_its_shape():
    batch = cached(Counted((4, 6)), size=1, batch=1)
    assert {tuple(batch([number])[0].shape) for number in range(8)} == {(1, 1, 4, 6)}


def test_crops_cover_the_frame_and_match():
    marked = Counted((5, 4))
    marked.batch = lambda numbers: Batch(*3 * (torch.arange(20.0).view(1, 1, 5, 4),))
    batch = cached(marked, size=1, batch=1, crop=3)
    crops = [batch([number]) for number in range(60)]
    assert all(torch.equal(estimates, scenes) and estimates.shape[-2:] == (3, 3) for estimates, _, scenes in crops)
    assert all(unit.item() == 19 for _, unit, _ in crops)  # of the whole frame
    assert {value for estimates, _, _ in crops for value in estimates.flatten().tolist()} == set(map(float, range(20)))


def test_a_number_is_the_same_sample_after_any_history():
    one, other = cached(Counted()), cached(Counted())
    other(range(7))
    torch.testing.assert_close(one([7])[0], other([7])[0])


def test_each_place_in_the_batch_has_its_own_samples():
    """A process always has the same places, so it computes no sample of another process."""
    pairs = Counted()
    batch = cached(pairs)
    for number in range(0, 24, 2):
        batch([number])
    assert sorted(pairs.asked) == [0, 2, 4]


def test_a_network_without_a_fixed_first_part_is_refused():
    with pytest.raises(ParameterError, match=r"`pool` \(5\) .*`pool = 0` and `crop = 0`"):
        SampleCache(Counted(), size=5, batch=1, crop=0, seed=0).front(build("unet", width=2))
    with pytest.raises(ParameterError, match=r"`pool` \(5\) must be a multiple of `batch` \(2\)"):
        cached(Counted(), size=5)


@pytest.mark.parametrize("rounds", [0, 1])
def test_the_bank_is_its_correction_of_its_estimates(rounds, generator):
    network = build("wiener-bank", width=2, align=False, rounds=rounds).eval()
    psf = torch.rand(1, 3, 32, 32, generator=generator)
    measurement = torch.rand(2, 3, 32, 32, generator=generator)
    estimates = network.estimates(measurement, psf)
    torch.testing.assert_close(network.correct(estimates, network.unit(estimates)), network(measurement, psf))


@pytest.mark.parametrize("fold", [1, 2])
def test_a_correction_leaves_the_estimates_as_they_were(fold, generator):
    network = build("wiener-bank", width=2, fold=fold, align=False).eval()
    estimates = torch.rand(1, 15, 64, 64, generator=generator).contiguous(memory_format=torch.channels_last)
    before = estimates.clone()
    network.correct(estimates, network.unit(estimates))
    assert torch.equal(estimates, before)
