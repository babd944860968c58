"""Checkpoints that were damaged or made to harm: refused on one line, within the memory and time of the driver."""

import itertools

import crafted_checkpoints as crafted
import driver
import numpy as np
import pytest

from mwdn.networks import NETWORKS
from mwdn.networks.empty import MAX_TENSORS, _Counted, build_empty
from mwdn.weights import load_checkpoint

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.mark.parametrize(("suffix", "cases"), [(".safetensors", crafted.own), (".pt", crafted.foreign)])
def test_crafted_checkpoints_are_refused(tmp_path, suffix, cases):
    """82 kB asked for 3 GB (`width`) and 6 GB (`iterations`); nesting, digits and 0-d tensors ended in tracebacks."""
    path, outcomes = tmp_path / f"a{suffix}", {}
    for what, content in cases():
        path.write_bytes(content)
        outcomes[what] = driver.outcome(lambda: load_checkpoint(path), path)
    assert {what: outcome for what, outcome in outcomes.items() if outcome != "refused"} == {}


def damaged(seed):
    random = np.random.default_rng(seed)
    while True:
        suffix, content = crafted.valid(random)
        yield suffix, driver.damaged(content, random)


def sweep(folder, cases, *, duration_s=float("inf")):
    """Outcomes of the cases of each suffix."""
    wrong = []
    for suffix in (".safetensors", ".pt"):
        contents = (content for kind, content in cases() if kind == suffix)
        outcomes = driver.sweep(contents, load_checkpoint, folder / f"a{suffix}", duration_s=duration_s / 2)
        print(suffix, dict(outcomes))
        wrong += driver.failures(outcomes)
    return wrong


def test_damaged_checkpoints(tmp_path):
    """73 of 556 ended in tracebacks of other libraries."""
    assert sweep(tmp_path, lambda: itertools.islice(damaged(29), 120)) == []


@pytest.mark.acceptance
def test_damaged_checkpoints_for_long(tmp_path):
    assert sweep(tmp_path, lambda: damaged(np.random.SeedSequence().entropy), duration_s=driver.DURATION_S) == []


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_is_far_from_the_limit_of_layers(name):
    """A limit that is too low would refuse checkpoints that were trained."""
    with _Counted() as counted:
        build_empty(name, **({"rounds": 1} if name == "wiener-bank" else {}))
    assert 0 < counted.count < MAX_TENSORS / 10
