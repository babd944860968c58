"""Initial weights of a run."""

import pytest
import torch

from mwdn.networks import build
from mwdn.training.network import build_network
from mwdn.training.recipe import Recipe
from mwdn.weights.growth import grown


@pytest.mark.parametrize("parts", [{"finest": 8}, {"rounds": 2}])
def test_new_inputs_and_outputs_start_without_effect(generator, parts):
    """A bank without evidence in one with it: the same scene."""
    options = {"width": 2, "regularisations": (1e-3,), "block": 8, **parts}
    old = build("wiener-bank", **options).eval()
    new = build("wiener-bank", **options, evidence=True, mean_light="gated").eval()
    new.load_state_dict(grown(old.state_dict(), new))
    psf, measurement = torch.rand(1, 3, 64, 72, generator=generator) ** 8, torch.rand(1, 3, 64, 72, generator=generator)
    with torch.no_grad():
        new.decoder.head.bias[-1] = -100  # a closed gate
        torch.testing.assert_close(new(measurement, psf), old(measurement, psf))


def test_random_numbers_of_the_caller_stay():
    """`mwdn.train` seeded the generator of the notebook that called it."""
    before = torch.get_rng_state()
    first, second = (build_network(Recipe({"name": "wiener-unet", "width": 2})) for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(map(torch.equal, first.state_dict().values(), second.state_dict().values()))


def test_a_smaller_network_keeps_the_weights_as_they_are():
    """Loading them then names what does not fit."""
    old, new = build("wiener-bank", width=4), build("wiener-bank", width=2)
    weights = grown(old.state_dict(), new)
    assert {name: value.shape for name, value in weights.items()} == {n: v.shape for n, v in old.state_dict().items()}
