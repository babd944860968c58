"""Four steps of training in the authors' form, against their code as `authors_code` writes it from the equations."""

from dataclasses import replace

import pytest
import torch

from authors_code import authors, authors_training
from cameras import contour_psf
from mwdn.calibration import Calibration
from mwdn.data.pairs import PairFile
from mwdn.data.recorded import Division
from mwdn.errors import ParameterError
from mwdn.evaluation.alexnet import AlexNet
from mwdn.training.experiment import prepare
from mwdn.training.recipe import Recipe, Schedule
from mwdn.weights.authors import AUTHORS_OPTIONS, renamed

STEPS, BATCH, SIZE = 4, 2, 48
EXACT = Schedule(
    steps=STEPS,
    batch=BATCH,
    lr_schedule="plateau",
    learning_rate=1e-4,
    optimiser="adam",
    weight_decay=1e-4,
    clip=0.0,
    ema=0.0,
    bfloat16=False,
    validate_every=STEPS,
    validation=1,
)


@pytest.fixture
def alexnet(tmp_path, monkeypatch):
    """Random weights of AlexNet, in the file that the loss loads."""
    weights = AlexNet().state_dict()
    torch.save(weights, tmp_path / "alexnet.pth")
    monkeypatch.setenv("MWDN_ALEXNET", str(tmp_path / "alexnet.pth"))
    return weights


@pytest.fixture
def psf(generator):
    """As stored: colours of different brightness."""
    psf = contour_psf((SIZE, SIZE), cell=20, generator=generator) * torch.tensor([0.6, 1.0, 0.8])[:, None, None]
    return psf / psf.max()


@pytest.fixture
def pairs(tmp_path, generator):
    shape = (SIZE, SIZE, 3)
    with PairFile.create(tmp_path / "pairs.h5", measurement_shape=shape, scene_shape=shape) as file:
        file.append(*(torch.rand(9, 3, SIZE, SIZE, generator=generator) for _ in range(2)))
    return tmp_path / "pairs.h5"


def recipe(name, start="", **options):
    network = {"name": name, "width": 4, **AUTHORS_OPTIONS, **options}
    loss = {"mse": 1.0, "feature_mse": 1.0}
    return Recipe(network, replace(EXACT, start=str(start)), loss, pairs=Division("folds", folds=9))


@pytest.mark.parametrize(
    ("name", "options"), [("mwdn", {"psf_pooling": "average"}), ("mwdn-cpsf", {"authors_scalars": True})]
)
def test_four_steps_are_theirs(tmp_path, name, options, alexnet, psf, pairs, generator):
    """As close to their code as that is to itself with its tensors in another memory layout."""
    start = authors(generator, cpsf=name == "mwdn-cpsf")
    torch.save({"net_state_dict": start}, tmp_path / "start.tar")
    calibration = Calibration(psf, light=tuple(psf.sum((-2, -1)).flatten().tolist()))
    trainer = prepare(
        recipe(name, tmp_path / "start.tar", **options), calibration, out=tmp_path, pairs=pairs, device="cpu"
    )
    batches = [trainer.task.samples.batch(range(i, i + BATCH))[:2] for i in range(0, STEPS * BATCH, BATCH)]
    for _ in range(STEPS):
        trainer.advance()
    ours = dict(trainer.network.named_parameters())
    theirs, again = (
        renamed(authors_training(start, batches, psf, alexnet, cpsf=name == "mwdn-cpsf", layout=layout), name)
        for layout in (torch.contiguous_format, torch.channels_last)
    )
    # Biases in front of a BatchNorm have no effect and are frozen here; theirs decay. So does their unused lambda.
    keys = [key for key, value in ours.items() if value.requires_grad and key != "unused_regularisation"]

    def distance(a, b):
        # 95 % of the numbers: where a gradient is rounding alone, Adam makes a whole step of either sign of it.
        return torch.cat([(a[key] - b[key]).detach().abs().flatten() for key in keys]).quantile(0.95).item()

    moved, nearest = distance(renamed(start, name), theirs), min(distance(ours, theirs), distance(ours, again))
    assert moved > 3e-4
    assert nearest <= distance(theirs, again)
    if name == "mwdn":  # most gradients of the other one's PSF encoder are rounding
        assert nearest < 0.01 * moved
        weights = [f"filters.{i}.linear_weight" for i in range(4)]
        assert all(abs(ours[key] - again[key]) < 1e-5 for key in weights)
        # 20 % of w; its logarithm would move by 0.04 %.
        assert max(abs(ours[key] - w) for key, w in zip(weights, start["w"], strict=True)) > 3e-4


def test_a_linear_w_may_become_negative(tmp_path, alexnet, psf, pairs):
    trainer = prepare(recipe("mwdn", weight=1e-5), Calibration(psf), out=tmp_path, pairs=pairs, device="cpu")
    weights = [wiener.linear_weight for wiener in trainer.network.filters]
    for _ in range(2):
        trainer.advance()
    assert min(weight.item() for weight in weights) < 0
    assert all(parameter.isfinite().all() for parameter in trainer.network.parameters())


def test_a_stored_psf_needs_pairs_of_one_camera(tmp_path, psf, pairs):
    aligned = replace(recipe("mwdn"), pairs=Division("folds", folds=9, aligned=True))
    with pytest.raises(ParameterError, match="takes the PSF as stored"):
        prepare(aligned, Calibration(psf), out=tmp_path, pairs=pairs, device="cpu")
