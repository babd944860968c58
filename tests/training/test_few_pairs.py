"""Learning from few recorded pairs: near the start weights, in any units, each pair estimated once."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.nn import functional as F

from cameras import contour_psf
from mwdn import Reconstructor
from mwdn.calibration import Calibration
from mwdn.data.pairs import PairFile
from mwdn.data.recorded import Division
from mwdn.errors import ParameterError
from mwdn.evaluation.metrics import best_gain
from mwdn.fourier.convolution import convolve
from mwdn.networks import build
from mwdn.optics.distortion import distort, undistort
from mwdn.optics.polynomials import polynomials
from mwdn.optics.shading import shade, shading
from mwdn.solvers.pose import Pose
from mwdn.training.experiment import prepare
from mwdn.training.recipe import Recipe, Schedule, read_recipe
from mwdn.weights.bundled import BUNDLED, load_network
from mwdn.weights.checkpoint import load_checkpoint, save_network
from mwdn.weights.growth import grown

OPTIONS = {"width": 2, "regularisations": (1e-2, 1e-4), "mean_light": "free", "finest": 8}
SCHEDULE = Schedule(
    steps=2, pool=200, batch=2, learning_rate=1e-2, warmup=0, validate_every=2, ema=0.0, weight_decay=0.0,
    anchor=1.0, fixed_norms=True, start="start.safetensors",
)  # fmt: skip
LARGE = 96, 96
DISTORTION = torch.tensor([[0.01, 0.0, 0.01, 0.015, -0.01, 0.01], [-0.01, 0.01, -0.01, 0.0, 0.01, -0.02]])
SHADING = torch.tensor(
    [[0.1, -0.3, 0.2, 0.4, 0.0, 0.3], [0.0, -0.3, 0.2, 0.4, 0.0, 0.3], [-0.2, -0.3, 0.2, 0.4, 0.0, 0.3]]
)
RECIPE = Recipe({"name": "wiener-bank", **OPTIONS}, SCHEDULE, pairs=Division("folds", aligned=True, best_gain=True))


@pytest.fixture(autouse=True)
def _aligned(tmp_path, monkeypatch):
    """Without the alignment of the pairs, 0.5 s each; `test_recorded.py` has it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mwdn.data.recorded.align", lambda *_: Pose(torch.zeros(1), torch.zeros(1)))


@pytest.fixture
def camera(generator):
    """A calibration, five pairs whose scenes are in units of their own, and random start weights."""
    psf = contour_psf((32, 32), cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()
    with PairFile.create("pairs.h5", measurement_shape=(32, 32, 3), scene_shape=(32, 32, 3)) as file:
        for number in range(5):
            scene = torch.rand(1, 3, 32, 32, generator=generator)
            units = scene * (0.2 + 0.1 * number) + 0.05 * number
            file.append(0.8 * convolve(scene, psf)[0], units[0])
    save_network("start.safetensors", build("wiener-bank", **OPTIONS).eval(), "wiener-bank", OPTIONS)
    return Calibration(psf)


def trainer(camera, **schedule):
    recipe = replace(RECIPE, schedule=replace(SCHEDULE, **schedule))
    return prepare(recipe, camera, out=folder_of(schedule), pairs=Path("pairs.h5"), device="cpu")


def folder_of(schedule):
    return Path("run-" + "-".join(map(str, schedule.values())))


def changes(folder):
    """Norms of the differences of all weights to the start."""
    start, end = (load_checkpoint(path).state_dict() for path in ("start.safetensors", f"{folder}/last.safetensors"))
    return {name: float((end[name].double() - start[name].double()).norm()) for name in start}


def test_pairs_are_estimated_once_statistics_stay_and_weights_move(camera):
    run = trainer(camera, steps=2)
    run.run()
    assert len(run.task.cache.samples) == 4  # of a batch of 2; a quarter of five is held out
    assert len(run.validator.task.samples) == 1
    assert run.task.samples.aligned
    moved = changes("run-2")
    assert not any(value for name, value in moved.items() if "running" in name or "num_batches" in name)
    assert moved["decoder.head.weight"] > 0


def test_an_anchor_of_one_over_the_learning_rate_holds_the_start(camera):
    """Each step ends at the start weights: rate x anchor = 1."""
    trainer(camera, anchor=1e4, steps=2).run()
    assert max(changes("run-10000.0-2").values()) < 1e-6


def test_a_share_of_the_start_is_mixed_into_what_was_learned(camera):
    """w = share w_start + (1 - share) w_learned, for every weight of the same run without a share."""
    trainer(camera, steps=2).run()
    trainer(camera, steps=2, start_share=0.75).run()
    start, plain, mixed = (
        load_checkpoint(f"{path}.safetensors").state_dict() for path in ("start", "run-2/last", "run-2-0.75/last")
    )
    for name, value in mixed.items():
        expected = 0.75 * start[name] + 0.25 * plain[name] if value.is_floating_point() else plain[name]
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6)


def test_the_start_is_kept_if_nothing_is_better(camera):
    """A learning rate that destroys the weights."""
    trainer(camera, learning_rate=0.5, anchor=1e-9).run()
    best = load_checkpoint("run-0.5-1e-09/best.safetensors").state_dict()
    start = load_checkpoint("start.safetensors").state_dict()
    assert all(torch.equal(best[name], start[name]) for name in start)


def test_validation_has_no_units(camera):
    """Scenes times two plus a half: gain and offset of each colour are free, so only 6 dB change."""
    run = trainer(camera, steps=1)
    held_out = run.validator.task
    first = held_out.score(run.average, run.distance, range(1)).psnr
    image = held_out.cache.reconstruct_whole(run.average, range(1))
    scene = held_out.samples.batch(range(1)).scene
    for units in (scene, 2 * scene + 0.5):
        fitted = held_out._in_units(image, units)
        torch.testing.assert_close(fitted.mean((2, 3)), units.mean((2, 3)))
    torch.testing.assert_close((fitted - units).square().mean().log10(), -first[0] / 10 + 2 * torch.tensor(2.0).log10())


@pytest.mark.parametrize("name", ["anchor", "start_share"])
def test_what_holds_the_start_needs_one(name):
    with pytest.raises(ParameterError, match=f"`{name}` .* needs the weights of `start`"):
        Schedule(**{name: 0.5})


def test_the_recipe_fits_the_bundled_network():
    recipe = read_recipe("few-pairs")
    network = build(**recipe.network)
    assert recipe.schedule.start in BUNDLED
    network.load_state_dict(grown(load_network(recipe.schedule.start).state_dict(), network))


def test_a_grey_camera_is_learned_from_as_equal_colours(camera):
    grey = Calibration(camera.psf.mean(1, keepdim=True))
    with PairFile.create("grey.h5", measurement_shape=(32, 32, 1), scene_shape=(32, 32, 1)) as file:
        for measurement, scene in PairFile(Path("pairs.h5")):
            file.append(measurement.mean(0, keepdim=True), scene.mean(0, keepdim=True))
    many = Path("many.h5")
    with PairFile.create(many, measurement_shape=(32, 32, 1), scene_shape=(32, 32, 1)) as file:
        for _ in range(10):
            file.append(torch.rand(1, 32, 32), torch.rand(1, 32, 32))
    recipe = replace(RECIPE, network=RECIPE.network | {"shading": 0})
    run = prepare(recipe, grey, out=Path("grey"), pairs=Path("grey.h5"), device="cpu")
    run.run()
    assert run.task.loss(run.network, run.distance, range(2))[0].isfinite()
    measurement, scene = PairFile(Path("grey.h5"))[4]
    reconstruct = Reconstructor("grey/last.safetensors", grey, align=False, room_light=False, device="cpu")
    assert reconstruct(measurement[None]).shape == scene[None].shape
    with pytest.raises(ParameterError, match=r"`channels` .*'unet' \(3\) must be 1"):
        prepare(replace(recipe, network={"name": "unet"}), grey, out=Path("no"), pairs=Path("grey.h5"), device="cpu")
    assert not Path("no").exists()
    prepare(Recipe({"name": "wiener"}, Schedule(steps=1)), grey, out=Path("any"), pairs=many, device="cpu").run()


@pytest.fixture
def distorted(generator):
    """A calibration, and five pairs whose scenes another camera saw: displaced by up to 3 pixels."""
    psf = contour_psf(LARGE, cell=24, generator=generator).expand(1, 3, -1, -1).contiguous()
    with PairFile.create("pairs.h5", measurement_shape=(*LARGE, 3), scene_shape=(*LARGE, 3)) as file:
        for number in range(5):
            scene = F.avg_pool2d(torch.rand(1, 3, LARGE[0] + 4, LARGE[1] + 4, generator=generator), 5, 1)
            scene[..., 20 + 9 * number :, 30:60] *= 0.3
            file.append(0.8 * convolve(distort(scene, DISTORTION), psf)[0], scene[0])
    options = OPTIONS | {"regularisations": (1e-3,), "finest": 1}
    save_network("start.safetensors", build("wiener-bank", **options).eval(), "wiener-bank", options)
    recipe = replace(RECIPE, network={"name": "wiener-bank", **options, "distortion": 2})
    return recipe, Calibration(psf)


def test_distorted_scenes_are_learned_from_and_reconstructed(distorted):
    recipe, calibration = distorted
    pairs = Path("pairs.h5")
    run = prepare(recipe, calibration, out=Path("run"), pairs=pairs, device="cpu")
    run.run()
    found = load_checkpoint("run/last.safetensors").state_dict()["distortion"]
    difference = torch.einsum("ck,khw->chw", found - DISTORTION, polynomials(2, LARGE).float()) * (LARGE[0] - 1) / 2
    assert difference.norm(dim=0)[8:-8, 8:-8].max() < 0.4
    assert torch.equal(run.network.distortion, found)
    assert torch.equal(run.average.distortion, found)

    measurement, scene = PairFile(pairs)[4]
    reconstruct = Reconstructor("run/best.safetensors", calibration, align=False, room_light=False, device="cpu")
    result, seen = reconstruct(measurement[None]), reconstruct.on_device(measurement[None])
    torch.testing.assert_close(result, undistort(seen, found))
    inner = ..., slice(8, -8), slice(8, -8)

    def error(picture):
        return float((best_gain(picture, scene[None]) - scene)[inner].square().mean())

    assert error(result) < 0.85 * error(seen)  # the rest is not displacement


def test_unevenly_lit_scenes_are_learned_from_and_reconstructed(distorted):
    """As above, but the scenes are recorded in other light instead."""
    recipe, calibration = distorted
    with PairFile.create("shaded.h5", measurement_shape=(*LARGE, 3), scene_shape=(*LARGE, 3)) as file:
        for measurement, scene in PairFile(Path("pairs.h5")):
            file.append(measurement, 0.3 * shade(distort(scene[None], DISTORTION), SHADING)[0])
    network = recipe.network | {"distortion": 0, "shading": 2}
    run = prepare(replace(recipe, network=network), calibration, out=Path("run"), pairs=Path("shaded.h5"), device="cpu")
    run.run()
    assert run.average.distortion is None
    found = run.average.shading
    assert torch.equal(run.network.shading, found)
    quotient = shading(found, LARGE) / shading(SHADING, LARGE)
    quotient = quotient / quotient.mean()
    assert quotient.max() / quotient.min() < 0.5 * shading(SHADING, LARGE).max() / shading(SHADING, LARGE).min()

    measurement, scene = PairFile(Path("shaded.h5"))[4]
    reconstruct = Reconstructor("run/best.safetensors", calibration, align=False, room_light=False, device="cpu")
    result, seen = reconstruct(measurement[None]), reconstruct.on_device(measurement[None])
    torch.testing.assert_close(result, shade(seen, found))

    def error(picture):
        return float((best_gain(picture, scene[None]) - scene).square().mean())

    assert error(result) < 0.85 * error(seen)


def test_nothing_is_measured_from_one_pair(distorted):
    """The batch of two held it twice, so it confirmed itself: a shading and a distortion of 4.6 dB."""
    recipe, calibration = distorted
    with PairFile.create("two.h5", measurement_shape=(*LARGE, 3), scene_shape=(*LARGE, 3)) as file:
        for number in range(2):
            file.append(*PairFile(Path("pairs.h5"))[number])
    options = {
        "network": recipe.network | {"shading": 2},
        "pairs": replace(recipe.pairs, split="folds", folds=2),
        "schedule": replace(recipe.schedule, steps=1, batch=2),
    }
    run = prepare(replace(recipe, **options), calibration, out=Path("run"), pairs=Path("two.h5"), device="cpu")
    run.run()
    assert not run.network.distortion.any()
    assert not run.network.shading.any()


def test_a_resumed_run_keeps_what_was_measured(distorted):
    recipe, calibration = distorted
    recipe = replace(recipe, network=recipe.network | {"shading": 1})

    def stopped(report):
        raise KeyboardInterrupt

    def run(folder, callback=lambda report: None):
        prepare(recipe, calibration, out=Path(folder), pairs=Path("pairs.h5"), device="cpu").run(callback)

    recipe = replace(recipe, schedule=replace(recipe.schedule, validate_every=1, start_share=0.3))
    run("whole")
    with pytest.raises(KeyboardInterrupt):
        run("stopped", stopped)
    run("stopped")
    whole, resumed = (load_checkpoint(f"{name}/last.safetensors").state_dict() for name in ("whole", "stopped"))
    assert whole["distortion"].any()
    assert whole["shading"].any()
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())
