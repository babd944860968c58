"""Self-supervised training: what its loss prefers, that it falls, and that a run resumes."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from cameras import contour_psf
from mwdn.calibration import Calibration
from mwdn.data.unpaired import SelfSupervised, UnpairedCaptures
from mwdn.errors import CheckpointError, ImageError, ParameterError, ShapeError
from mwdn.fourier.convolution import convolve
from mwdn.fourier.wiener import wiener
from mwdn.networks.activation_checkpointing import batch_norms
from mwdn.optics.noise import noise_level
from mwdn.solvers.pose import Pose
from mwdn.training.experiment import prepare
from mwdn.training.losses import Loss
from mwdn.training.recipe import Recipe, Schedule
from mwdn.training.selfsupervised import selfsupervised_loss, unexplained
from mwdn.training.tables import Sheet
from mwdn.weights import bundled

RECIPE = Recipe(
    {"name": "wiener-bank", "width": 4, "regularisations": (1e-2, 1e-4), "finest": 0},
    Schedule(steps=6, batch=2, learning_rate=2e-3, warmup=0, ema=0.5, validate_every=3, validation=3, bfloat16=False),
    selfsupervised=SelfSupervised(consistency=1.0),
)
NO_POSE = Pose(torch.zeros(1), torch.zeros(1))


def captures_of(scenes, psf, noise=0.0, **settings):
    """Captures of scenes by a camera whose PSF is already aligned."""
    seen = convolve(scenes, psf)
    seen = seen + noise * torch.randn(seen.shape, generator=torch.Generator().manual_seed(5))
    poses = dict.fromkeys(range(len(seen)), NO_POSE)
    return UnpairedCaptures(seen, psf, SelfSupervised(consistency=1.0, **settings), poses=poses)


class Answer(nn.Module):
    """A network that computes a given function."""

    def __init__(self, of):
        super().__init__()
        self.of = of

    def forward(self, measurement, psf):
        return self.of(measurement, psf)


@pytest.fixture
def scenes(generator):
    """Bright blocks in the middle of a dark frame."""
    blocks = torch.rand(4, 3, 6, 6, generator=generator).repeat_interleave(4, -1).repeat_interleave(4, -2)
    return nn.functional.pad(blocks, (20, 20, 20, 20))


# --- The samples --------------------------------------------------------------------------------------


def test_noise_is_split_into_two_uncorrelated_parts():
    flat = torch.full((2, 3, 128, 128), 0.5)
    delta = torch.zeros(1, 1, 128, 128)
    delta[..., 64, 64] = 1
    captures = captures_of(flat, delta, noise=0.02, recorruption=0.5)
    one, other, _ = captures.batch(range(2))
    one, other = one - flat, other - flat
    assert one.std() == pytest.approx(0.02 * (1 + 0.25) ** 0.5, rel=0.02)
    assert other.std() == pytest.approx(0.02 * (1 + 4) ** 0.5, rel=0.02)
    # 98,304 pixels: by chance alone 0.003.
    assert (one * other).mean() / (one.std() * other.std()) == pytest.approx(0, abs=0.015)
    whole = replace(captures, settings=SelfSupervised(recorruption=0.0))
    assert all(
        torch.equal(each, whole.measurements[[whole.row(0), whole.row(1)]]) for each in whole.batch(range(2))[:2]
    )


def test_an_epoch_has_each_capture_once(scenes, generator):
    captures = captures_of(scenes, contour_psf((64, 64), cell=10, generator=generator))
    for epoch in range(3):
        assert sorted(captures.row(4 * epoch + place) for place in range(4)) == [0, 1, 2, 3]


def test_moved_scenes_are_captured_in_all_symmetries(scenes, generator):
    psf = contour_psf((64, 64), cell=10, generator=generator)
    captures = captures_of(scenes, psf, shift=0.2)
    numbers = range(40)
    first, light = scenes[:1].expand(40, -1, -1, -1), torch.full((40, 3, 1, 1), 0.25)
    measurement, moved = captures.recapture(first, psf.expand(40, -1, -1, -1), light, numbers)
    noise = measurement - convolve(moved, psf) - 0.25
    level = noise_level(captures.measurements)[[captures.row(number) for number in numbers]]
    assert (noise / level).std() == pytest.approx(1, rel=0.02)
    assert (noise / level).mean() == pytest.approx(0, abs=0.02)
    for one in moved:  # the blocks are whole, wherever they are
        torch.testing.assert_close(one.flatten(1).sort().values, scenes[0].flatten(1).sort().values)
    assert len({tuple(one.flatten().tolist()) for one in moved}) == 40
    square = [one[:, one[0].sum(1) > 0][:, :, one[0].sum(0) > 0] for one in moved]
    assert len({tuple(one.flatten().tolist()) for one in square}) == 8


def test_a_frame_that_is_not_square_is_not_transposed(generator):
    psf = contour_psf((24, 32), cell=8, generator=generator)
    captures = captures_of(torch.rand(1, 3, 24, 32, generator=generator), psf)
    _, moved = captures.recapture(captures.measurements.expand(9, -1, -1, -1), psf, torch.zeros(9, 3, 1, 1), range(9))
    assert moved.shape == (9, 3, 24, 32)


# --- What the loss prefers ----------------------------------------------------------------------------


def test_the_truth_beats_every_trivial_and_wrong_answer(scenes, generator):
    small = contour_psf((32, 32), cell=8, generator=generator)  # no light leaves the sensor: it is invertible
    psf = nn.functional.pad(small, (16, 16, 16, 16))
    captures = captures_of(scenes, psf, recorruption=0.0, shift=0.05)

    def truth(b, psf):
        return wiener(b, psf, 1e-4, boundary="zero")

    wrong = {
        "nothing": lambda b, psf: torch.zeros_like(b),
        "the measurement": lambda b, psf: b,
        "too smooth": lambda b, psf: wiener(b, psf, 3e-2, boundary="zero"),
        "mirrored": lambda b, psf: truth(b, psf).flip(-1),
        "displaced": lambda b, psf: truth(b, psf).roll(2, -1),
        "another camera's": lambda b, psf: truth(b, psf.flip(-2)),
        "too dark": lambda b, psf: truth(b, psf) / 2,
    }
    loss = Loss({"mse": 1.0})
    right = selfsupervised_loss(captures, Answer(truth), loss, range(4))
    for name, answer in wrong.items():
        assert selfsupervised_loss(captures, Answer(answer), loss, range(4)).loss > 3 * right.loss, name
    assert right.parts["unexplained"] < 0.01


def test_equivariance_penalises_what_the_camera_cannot_see(scenes, generator):
    """Stripes of one pixel vanish in a PSF of two pixels: they are consistent, but do not move with the scene."""
    psf = torch.zeros(1, 1, 64, 64)
    psf[..., 32, 31:33] = 0.5
    height = torch.rand(64, 1, generator=generator).mul(0.3) * (torch.arange(64) % 2 * 2 - 1.0)
    stripes = nn.functional.pad(height[:, 8:-8], (8, 8))
    captures = captures_of(scenes, psf, recorruption=0.0)
    clean = Answer(lambda b, psf: wiener(b, psf, 1e-2, boundary="zero"))
    ghost = Answer(lambda b, psf: wiener(b, psf, 1e-2, boundary="zero") + stripes)
    loss = Loss({"mse": 1.0})
    one, other = (selfsupervised_loss(captures, network, loss, range(4)).parts for network in (clean, ghost))
    assert other["unexplained"] == pytest.approx(float(one["unexplained"]), abs=0.02)
    assert other["mse"] > 3 * one["mse"]


def test_uniform_light_does_not_count_and_black_explains_nothing(scenes):
    light = torch.tensor([0.1, 0.5, -0.2])[:, None, None]
    torch.testing.assert_close(unexplained(scenes, scenes + light), torch.zeros(4), atol=1e-6, rtol=0)
    torch.testing.assert_close(unexplained(torch.zeros_like(scenes), scenes + light), torch.ones(4))
    torch.testing.assert_close(unexplained(scenes / 2, scenes), torch.full((4,), 0.25))


# --- A run --------------------------------------------------------------------------------------------


@pytest.fixture
def calibration(generator):
    return Calibration(contour_psf((64, 64), cell=10, generator=generator).expand(1, 3, -1, -1).contiguous())


@pytest.fixture
def run(scenes, calibration, tmp_path):
    """``run(recipe, folder)`` is set up on three captures in a folder."""
    (tmp_path / "captures").mkdir()
    for number, one in enumerate(convolve(scenes, calibration.psf)[:3]):
        frame = (0.5 * one / one.max()).clamp(0, 1).movedim(0, -1).numpy()
        np.save(tmp_path / "captures" / f"{number}.npy", np.round(frame * 4095).astype(np.float32) / 4095)
    shown = Sheet((str(tmp_path / "captures"),))

    def make(recipe=RECIPE, folder="run", **named):
        return prepare(replace(recipe, sheet=shown), calibration, out=tmp_path / folder, device="cpu", **named)

    return make


@pytest.fixture
def no_alignment(monkeypatch):
    """Without the poses of the captures, which take longer than six steps; `test_the_loss_falls` has them."""
    monkeypatch.setattr("mwdn.data.unpaired.align", lambda *_: NO_POSE)


def test_the_loss_falls(run):
    trainer = run(replace(RECIPE, schedule=replace(RECIPE.schedule, steps=20, validate_every=20)))
    with torch.no_grad():
        trainer.network.decoder.head.weight.mul_(30)  # begin with wrong pictures
        trainer.average.load_state_dict(trainer.network.state_dict())
    trainer.run()
    lines = (trainer.out / "log.jsonl").read_text(encoding="utf-8").splitlines()
    losses = [json.loads(line)["loss"] for line in lines]
    assert sum(losses[-4:]) < 0.7 * sum(losses[:4])
    assert trainer.validator.recipe.schedule.validation == 3
    assert (trainer.out / "validation.png").is_file()


@pytest.mark.usefixtures("no_alignment")
@pytest.mark.parametrize("fixed", [False, True])
def test_fixed_norms_keep_their_statistics(fixed, run):
    trainer = run(replace(RECIPE, schedule=replace(RECIPE.schedule, fixed_norms=fixed)))
    layers = batch_norms(trainer.network)
    before = [(norm.running_mean.clone(), norm.weight.detach().clone()) for norm in layers]
    trainer.advance()
    pairs = list(zip(layers, before, strict=True))
    assert {torch.equal(norm.running_mean, mean) for norm, (mean, _) in pairs} == {fixed}
    assert any(not torch.equal(norm.weight, weight) for norm, (_, weight) in pairs)


@pytest.mark.usefixtures("no_alignment")
def test_a_resumed_run_ends_as_an_unbroken_one(run, calibration, tmp_path):
    run(folder="whole").run()
    stopped = run(folder="stopped")
    while stopped.step < 3:
        stopped.advance()
    stopped.save(stopped.validate())
    assert run(folder="stopped").step == 3
    run(folder="stopped").run()
    whole, other = ((tmp_path / name / "last.safetensors").read_bytes() for name in ("whole", "stopped"))
    assert whole == other
    (tmp_path / "captures" / "0.npy").unlink()
    with pytest.raises(CheckpointError, match="on other pairs"):
        run(folder="stopped")


def test_what_is_missing_or_does_not_fit(run, calibration, tmp_path):
    out = tmp_path / "run"
    with pytest.raises(ParameterError, match="give `captures`"):
        prepare(RECIPE, calibration, out=out, device="cpu")
    with pytest.raises(ParameterError, match=r"\[selfsupervised\]"):
        run(pairs=tmp_path / "pairs.h5")
    with pytest.raises(ParameterError, match="leave `pool` of"):
        replace(RECIPE, schedule=replace(RECIPE.schedule, pool=4))
    with pytest.raises(ParameterError, match=r"`shift` \(1.0\) must be in \[0, 1\)"):
        SelfSupervised(shift=1.0)
    np.save(tmp_path / "captures" / "9.npy", np.ones((32, 40, 3), np.float32))
    with pytest.raises(ShapeError, match=r"9.npy`: .*same height and width"):
        run()


def test_a_capture_without_light_is_refused(run, tmp_path):
    np.save(tmp_path / "captures" / "black.npy", np.zeros((64, 64, 3), np.float32))
    with pytest.raises(ImageError, match=r"black\.npy`: the sensor saw no light"):
        run()


@pytest.mark.usefixtures("no_alignment")
def test_a_run_begins_with_the_weights_of_the_package(run, tmp_path, monkeypatch):
    first = run()
    first.save(first.validate())
    monkeypatch.setattr(bundled, "_FOLDER", tmp_path / "weights")
    bundled.bundle(tmp_path / "run" / "last.safetensors", tmp_path / "weights" / "universal.safetensors")
    second = run(replace(RECIPE, schedule=replace(RECIPE.schedule, start="universal")), "second")
    for one, other in zip(second.network.parameters(), first.average.parameters(), strict=True):
        torch.testing.assert_close(one, other.half().float(), atol=1e-7, rtol=0)
