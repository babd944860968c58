"""Learning rate schedules: the cosine by its formula, the paper's against torch's own scheduler."""

import itertools
import json
import math
import random
from dataclasses import replace

import pytest
import torch
from torch import nn

from mwdn.networks import build
from mwdn.optics import Camera
from mwdn.training.recipe import Recipe, Schedule
from mwdn.training.schedule import (
    FixedSchedule,
    ReduceLROnPlateau,
    learning_rate,
    make_lr_schedule,
    make_optimiser,
    set_rate,
)
from mwdn.training.tables import Plateau

FIRST, LATER = {"mse": 1.0, "feature_mse": 1.0}, {"mse": 1.0, "feature_mse": 0.05}
PAPER = Recipe({"name": "mwdn"}, Schedule(lr_schedule="plateau", learning_rate=1e-4), FIRST, later_loss=LATER)


# --- Cosine -------------------------------------------------------------------------------------------


def test_learning_rate_rises_then_falls_as_half_a_cosine():
    schedule = Schedule(steps=110, warmup=10, learning_rate=2.0)
    rates = [learning_rate(step, schedule) for step in range(111)]
    assert rates[:10] == pytest.approx([0.2 * (step + 1) for step in range(10)])
    assert rates[10] == pytest.approx(2.0)
    assert rates[35] == pytest.approx(2.0 * (0.01 + 0.99 * (1 + 0.5**0.5) / 2))  # an eighth of a period
    assert rates[60] == pytest.approx(2.0 * (0.01 + 0.99 / 2))
    assert rates[110] == pytest.approx(0.02)
    assert all(a > b for a, b in itertools.pairwise(rates[10:]))
    assert learning_rate(0, Schedule(warmup=0, learning_rate=2.0)) == 2.0


def test_cosine_is_independent_of_the_validation():
    lr = make_lr_schedule(replace(PAPER, schedule=Schedule(), later_loss={}))
    assert isinstance(lr, FixedSchedule)
    assert lr.after(1.0) == lr
    assert (lr.finished, lr.loss_weights, lr.state()) == (False, FIRST, {})
    assert lr.rate(7) == learning_rate(7, Schedule())


# --- Plateau -----------------------------------------------------------------------------------------


def losses(seed):
    """Losses that fall, stay, jitter about torch's threshold of 1e-4, and are sometimes NaN."""
    drawn = random.Random(seed)
    loss = 1.0
    while True:
        loss *= drawn.choice([1, 1, 1, 1 - 0.5e-4, 1 - 1.5e-4, 0.9, 1.2])
        yield math.nan if drawn.random() < 0.05 else loss


@pytest.mark.parametrize("plateau", [Plateau(), Plateau(factor=0.5, patience=2), Plateau(patience=0)])
@pytest.mark.parametrize("seed", range(5))
def test_learning_rate_falls_when_torchs_does(seed, plateau):
    parameter = nn.Parameter(torch.zeros(1))
    optim = torch.optim.Adam([parameter], lr=1e-4)
    oracle = torch.optim.lr_scheduler.ReduceLROnPlateau(optim, factor=plateau.factor, patience=plateau.patience)
    lr, rates = make_lr_schedule(replace(PAPER, plateau=plateau)), []
    for loss in losses(seed):
        lr = lr.after(loss)
        oracle.step(loss)
        rates.append(lr.rate(len(rates)))
        assert rates[-1] == optim.param_groups[0]["lr"]
        assert lr.loss_weights == (FIRST if rates[-1] > 1.0001e-6 else LATER)
        assert lr.finished == (rates[-1] < 2e-8)
        if lr.finished:
            break
    assert len(set(rates)) > 4


def test_phases_of_the_paper():
    """A loss that never falls: the first validation is the lowest, then every sixth reduces the rate."""
    lr, phases = make_lr_schedule(PAPER), []
    for validation in range(1, 40):
        lr = lr.after(1.0)
        phases.append((validation, round(math.log10(lr.rate(0))), lr.loss_weights["feature_mse"]))
        if lr.finished:
            break
    changes = [after for before, after in itertools.pairwise(phases) if before[1:] != after[1:]]
    assert phases[0] == (1, -4, 1.0)
    assert changes == [(7, -5, 1.0), (13, -6, 0.05), (19, -7, 0.05), (25, -8, 0.05)]
    assert phases[-1][0] == 25


def test_one_weighting_throughout():
    lr = replace(make_lr_schedule(replace(PAPER, later_loss={})), current=1e-7)
    assert lr.loss_weights == FIRST


def test_limits_allow_for_rounding():
    """1e-4 x 0.1 x 0.1 is a little more than 1e-6."""
    assert 1e-4 * 0.1 * 0.1 > 1e-6
    assert ReduceLROnPlateau(PAPER, 1e-4 * 0.1 * 0.1).loss_weights == LATER
    assert not ReduceLROnPlateau(PAPER, 2e-8 * (1 - 1e-15)).finished


def test_state_goes_through_json_to_the_last_bit():
    lr = make_lr_schedule(PAPER)
    assert make_lr_schedule(PAPER, **json.loads(json.dumps(lr.state()))) == lr
    stream = losses(7)
    for _ in range(20):
        lr = lr.after(next(stream))
    assert lr.bad or lr.current < 1e-4
    assert make_lr_schedule(PAPER, **json.loads(json.dumps(lr.state()))) == lr


def test_a_constant_rate():
    schedule = Schedule(steps=100, warmup=4, lr_schedule="constant", learning_rate=0.5)
    assert [learning_rate(step, schedule) for step in (0, 3, 4, 50, 99)] == [0.125, 0.5, 0.5, 0.5, 0.5]


# --- Optimiser ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "physical"), [("mwdn", 8), ("mwdn-cpsf", 4), ("wiener-unet", 2), ("unet", 0)])
def test_adam_decays_all_but_w_and_lambda(name, physical):
    """With zero gradients, Adam moves only decayed parameters, towards 0."""
    network = build(name, width=4)
    before = {key: value.detach().clone() for key, value in network.named_parameters()}
    optim = make_optimiser(network, Schedule(optimiser="adam", learning_rate=1e-6, weight_decay=1e-2))
    assert type(optim) is torch.optim.Adam
    for parameter in network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optim.step()
    still = [key for key, value in network.named_parameters() if torch.equal(value, before[key]) and value.any()]
    assert len(still) == physical
    assert all(key.endswith(("log_weight", "log_regularisation")) for key in still)


def test_adamw_decays_convolutions_alone():
    network = build("mwdn", width=4)
    optim = make_optimiser(network, Schedule(weight_decay=0.3))
    assert type(optim) is torch.optim.AdamW
    decay = {id(p): group["weight_decay"] for group in optim.param_groups for p in group["params"]}
    assert all(decay[id(p)] == (0.3 if p.ndim == 4 else 0) for p in network.parameters())


def test_filters_have_a_rate_of_their_own():
    network = build("mwdn", width=4)
    optim = make_optimiser(network, Schedule(filter_rate=30.0))
    set_rate(optim, 2e-3)
    rates = {id(p): group["lr"] for group in optim.param_groups for p in group["params"]}
    for name, parameter in network.named_parameters():
        of_filter = name.endswith(("log_weight", "log_regularisation"))
        assert rates[id(parameter)] == pytest.approx(6e-2 if of_filter else 2e-3)


def test_a_learned_wiener_filter_reaches_its_optimum(generator):
    """100 steps from the paper's initial values, against the best lambda of a grid, with the best w for each."""
    psf = torch.rand(1, 1, 32, 32, generator=generator) ** 16
    scene = torch.rand(4, 1, 4, 4, generator=generator).repeat_interleave(8, -1).repeat_interleave(8, -2)
    light = Camera(psf)(scene)
    measurement = light + 0.03 * light.mean() * torch.randn(light.shape, generator=generator)
    network = build("wiener")

    def error():
        return (network(measurement, psf) - scene).square().mean()

    schedule = Schedule(steps=100, warmup=0, filter_rate=100.0)
    optim = make_optimiser(network, schedule)
    for step in range(schedule.steps):
        set_rate(optim, learning_rate(step, schedule))
        optim.zero_grad()
        error().backward()
        optim.step()
    learned = 10 * error().log10()
    # At w = 1 the estimate is w times the one at (w, w^2 lambda): the best w is a least-squares gain.
    best = []
    with torch.no_grad():
        network.filter.log_weight.fill_(0)
        for log_ratio in torch.arange(-8, 6, 0.5):
            network.filter.log_regularisation.fill_(log_ratio)
            estimate = network(measurement, psf)
            gain = (estimate * scene).sum() / estimate.square().sum()
            best.append(10 * (gain * estimate - scene).square().mean().log10())
    assert learned < min(best) + 0.2
