"""The training loop: it learns, and a run that is interrupted anywhere ends as an unbroken one."""

import errno
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from cameras import contour_psf
from made import touch
from mwdn.calibration import Calibration
from mwdn.cli.app import main
from mwdn.data.cameras import Cameras
from mwdn.data.noisy import Denoising
from mwdn.data.pairs import PairFile
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import SimulatedPairs
from mwdn.errors import CheckpointError, DivergenceError, ParameterError, ShapeError
from mwdn.inference.methods import find_method
from mwdn.optics.sensor import Sensor
from mwdn.training.experiment import prepare, simulate
from mwdn.training.recipe import Recipe, Schedule
from mwdn.training.run_folder import RunFolder
from mwdn.training.schedule import learning_rate
from mwdn.training.tables import Plateau, Sheet
from mwdn.training.tasks import SupervisedTask
from mwdn.training.trainer import Trainer
from mwdn.training.training_state import read_state
from mwdn.training.validation import Validation
from mwdn.weights.checkpoint import load_checkpoint, read_metadata
from runs import log, same

# Without iterations and alignment, which learn nothing and take most of the time.
FAST = {"finest": 0, "align": False}
RECIPE = Recipe(
    {"name": "wiener-bank", "width": 4, "regularisations": (1e-2, 1e-4), **FAST},
    Schedule(steps=6, batch=2, learning_rate=2e-3, warmup=2, ema=0.9, validate_every=3, validation=3),
)
DRUNET = {"name": "drunet"}  # of the size that wiener-bank has


def few(**schedule):
    return replace(RECIPE, schedule=replace(RECIPE.schedule, **schedule))


def smooth_photos(folder):
    """Three pictures in a new folder."""
    folder.mkdir()
    drawn = np.random.default_rng(2)
    for number in range(3):
        smooth = cv2.resize(drawn.integers(0, 256, (4, 4, 3), np.uint8), (24, 24), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number}.png"), smooth)
    return folder


def small_camera():
    generator = torch.Generator().manual_seed(20230731)
    return Calibration(contour_psf((32, 32), cell=10, generator=generator).expand(1, 3, -1, -1).contiguous())


@pytest.fixture
def photos(tmp_path):
    return smooth_photos(tmp_path / "photos")


@pytest.fixture
def calibration():
    return small_camera()


@pytest.fixture
def trainer(photos, calibration, tmp_path):
    """``trainer(recipe, folder)``"""

    def make(recipe=RECIPE, folder="run"):
        return prepare(recipe, calibration, photos=photos, out=tmp_path / folder, device="cpu")

    return make


def unbroken_run(recipe, folder):
    """Folder of a run that nothing stopped."""
    prepare(recipe, small_camera(), photos=smooth_photos(folder / "photos"), out=folder / "run", device="cpu").run()
    return folder / "run"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return unbroken_run(RECIPE, tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def whole_float32(tmp_path_factory):
    return unbroken_run(few(bfloat16=False), tmp_path_factory.mktemp("float32"))


@pytest.fixture
def finished(whole, photos, tmp_path):
    """The folder `run` of a run that has ended, a copy of `whole`."""
    return shutil.copytree(whole, tmp_path / "run")


@pytest.fixture(scope="module")
def whole_paper(tmp_path_factory):
    return unbroken_run(PAPER, tmp_path_factory.mktemp("paper"))


def stop(trainer, step):
    """Run, and stop after a step as a crash would: its validation and state are saved, if they are due."""

    def interrupt(report):
        if report.step == step:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.run(interrupt)


def advance(trainer):
    """Three steps, then a validation and a saved state."""
    for _ in range(3):
        trainer.advance()
    trainer.save(trainer.validate())


def assert_same_end(folder, unbroken):
    """Weights, state and log are those of the run that nothing stopped."""
    for name in ("last", "best", "state"):
        assert same(unbroken / f"{name}.safetensors", folder / f"{name}.safetensors")
    assert log(folder) == log(unbroken)


# --- Learning -----------------------------------------------------------------------------------------


class FourPairs(SimulatedPairs):
    """Always the first four."""

    def batch(self, numbers):
        return super().batch(range(4)[: len(numbers)])


def test_overfits_four_pairs(photos, calibration, tmp_path):
    recipe = few(steps=25, batch=4, warmup=5, learning_rate=5e-3, validate_every=25, validation=4, bfloat16=False)
    pairs = FourPairs(Photographs(photos, side=24), calibration.psf)
    losses = []
    trainer = Trainer(recipe, SupervisedTask(pairs), out=tmp_path / "run", calibration=calibration)
    best = trainer.run(lambda report: losses.append(report.loss))
    assert sum(losses[-5:]) < 0.3 * sum(losses[:5])
    scenes = pairs.batch(range(4)).scene
    assert best > -10 * torch.log10(scenes.square().mean())  # better than black


def test_checkpointing_is_the_same_run(trainer, whole_float32, tmp_path):
    """It may be switched on in the middle of a run, if memory is too short."""
    advance(trainer(few(bfloat16=False), "changed"))
    second = trainer(few(bfloat16=False, checkpointing=True), "changed")
    assert second.step == 3
    second.run()
    assert second.network.encoder.checkpoints_activations
    kept, changed = (load_file(run / "last.safetensors") for run in (whole_float32, tmp_path / "changed"))
    for key, value in kept.items():
        torch.testing.assert_close(changed[key], value, rtol=1e-3, atol=1e-5)


def test_each_step_has_its_learning_rate(trainer):
    run = trainer()
    for step in range(4):
        run.advance()
        assert {group["lr"] for group in run.optimiser.param_groups} == {learning_rate(step, run.schedule)}


def test_moving_average_of_the_weights(trainer):
    """Decay min(ema, n / (n + 10)) after step n, from the initial weights on; counters are copied."""
    run = trainer(few(ema=0.15))
    mean = {key: value.clone() for key, value in run.network.state_dict().items()}
    for step in range(1, 4):
        run.advance()
        decay = min(0.15, step / (step + 10))
        for key, value in run.network.state_dict().items():
            mean[key] = decay * mean[key] + (1 - decay) * value if value.is_floating_point() else value.clone()
    for key, value in run.average.state_dict().items():
        torch.testing.assert_close(value, mean[key], rtol=1e-5, atol=1e-7)


def test_without_ema_the_last_weights_are_used(trainer):
    run = trainer(few(ema=0.0))
    run.advance()
    for mean, value in zip(run.average.state_dict().values(), run.network.state_dict().values(), strict=True):
        assert torch.equal(mean, value)


# --- Files --------------------------------------------------------------------------------------------


def test_files_of_a_run(trainer, calibration, tmp_path):
    reports = []
    best = trainer().run(reports.append)
    out = tmp_path / "run"
    assert sorted(path.name for path in out.iterdir()) == [
        *("best.safetensors", "last.safetensors", "log.jsonl", "recipe.json", "state.safetensors", "validation.png")
    ]
    lines = log(out)
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert [line["step"] for line in lines if line["psnr"] is not None] == [3, 6]
    assert best == max(line["psnr"] for line in lines if line["psnr"] is not None)
    assert [line["learning_rate"] for line in lines] == [learning_rate(step, RECIPE.schedule) for step in range(6)]
    assert [report.loss for report in reports] == [line["loss"] for line in lines]
    header = read_metadata(out / "best.safetensors")
    assert (header["name"], header["psf_hash"], header["psnr"]) == ("wiener-bank", calibration.psf_hash, best)
    assert header["recipe"]["schedule"]["steps"] == 6
    assert read_metadata(out / "last.safetensors")["step"] == 6
    assert load_checkpoint(out / "best.safetensors")(torch.rand(1, 3, 32, 32), calibration.psf).shape == (1, 3, 32, 32)


def test_network_with_an_unused_parameter_is_resumed(trainer, tmp_path):
    """The authors' fifth lambda never has a gradient."""
    network = {"name": "mwdn-cpsf", "width": 2, "authors_scalars": True}
    recipe = replace(few(steps=2, validate_every=1), network=network)
    trainer(recipe, "whole").run()
    stop(trainer(recipe, "halves"), 1)
    assert trainer(recipe, "halves").step == 1
    trainer(recipe, "halves").run()
    assert_same_end(tmp_path / "halves", tmp_path / "whole")


@pytest.mark.parametrize(("best_by", "step"), [("psnr", 2), ("loss", 1)])
def test_the_best_weights_are_chosen_by_psnr_or_loss(trainer, tmp_path, best_by, step):
    """The second validation has the higher PSNR, the first the lower loss."""
    run = trainer(few(best_by=best_by))
    for psnr, loss in ((10.0, 0.1), (20.0, 0.2)):
        run.step += 1
        run.save(Validation(psnr, loss))
    assert read_metadata(tmp_path / "run" / "best.safetensors")["step"] == step
    assert trainer(few(best_by=best_by)).best == run.best


def test_resumed_run_ends_bit_identical(trainer, whole_float32, tmp_path):
    """In float32; `RECIPE`, in bfloat16, in the test after this one."""
    recipe = few(bfloat16=False)
    first = trainer(recipe, "halves")
    advance(first)
    second = trainer(recipe, "halves")
    assert (second.step, second.best) == (3, first.best)
    second.run()
    for name in ("last", "best", "state"):
        assert same(whole_float32 / f"{name}.safetensors", tmp_path / "halves" / f"{name}.safetensors")


def test_ctrl_c_ends_after_the_step_and_saves_it(trainer, whole, tmp_path):
    first = trainer()

    def press(report):
        if report.step == 2:  # no validation is due
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match=r"after step 2\."):
        first.run(press)
    second = trainer()
    assert second.step == 2
    second.run()
    assert_same_end(tmp_path / "run", whole)


def test_second_ctrl_c_ends_at_once(trainer, tmp_path):
    def press_twice(report):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        trainer().run(press_twice)
    assert trainer().step == 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_log_has_one_line_a_step_after_a_resume(trainer, tmp_path):
    """Interrupted after step 5, in the middle of a line; resumed from step 3."""
    stop(trainer(), 5)
    path = tmp_path / "run" / "log.jsonl"
    before = log(tmp_path / "run")
    path.write_text(path.read_text() + '{"step": 6, "lo')
    trainer().run()
    after = log(tmp_path / "run")
    assert [line["step"] for line in after] == [1, 2, 3, 4, 5, 6]
    assert after[:5] == before
    assert trainer().run() == max(line["psnr"] for line in after if line["psnr"] is not None)  # nothing left to do
    assert log(tmp_path / "run") == after


def test_log_of_a_run_without_a_state_starts_again(trainer, tmp_path):
    stop(trainer(), 1)
    trainer()
    assert log(tmp_path / "run") == []


def test_killed_between_log_and_state_repeats_the_step(trainer, tmp_path, monkeypatch):
    run = trainer()
    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "save", lambda self, psnr: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run.run()
    trainer().run()
    assert [line["step"] for line in log(tmp_path / "run")] == [1, 2, 3, 4, 5, 6]


TOML = """
network = { name = "wiener-bank", width = 4, regularisations = [1e-2, 1e-4], finest = 0, align = false }
schedule = { steps = 30, batch = 1, warmup = 2, ema = 0.9, validate_every = 7, validation = 2 }
"""


def command(folder, calibration, photos):
    """``mwdn train`` without ``--out``, to be called in a folder that gets the recipe and the PSF."""
    (folder / "r.toml").write_text(TOML, encoding="utf-8")
    np.save(folder / "psf.npy", calibration.psf[0].movedim(0, -1).numpy() / calibration.psf.max().item())
    return ["train", "r.toml", "--psf", "psf.npy", "--photos", str(photos), "--device", "cpu"]


@pytest.mark.acceptance
def test_killed_runs_end_as_an_unbroken_one(photos, calibration, tmp_path):
    """SIGKILL after a random number of steps, then undisturbed."""
    line = [sys.executable, "-m", "mwdn", *command(tmp_path, calibration, photos)]
    options = {"cwd": tmp_path, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "env": os.environ}

    def start(folder):
        return subprocess.Popen([*line, "--out", folder], **options)

    def lines():
        path = tmp_path / "killed" / "log.jsonl"
        return path.read_bytes().count(b"\n") if path.exists() else 0

    whole = start("whole")
    process, goal = start("killed"), random.randint(3, 15)
    while process.poll() is None and lines() < goal:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    for process in (whole, start("killed")):
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
    assert_same_end(tmp_path / "killed", tmp_path / "whole")
    assert [line["step"] for line in log(tmp_path / "killed")] == list(range(1, 31))


def hold(folder, held):
    """Keep other runs out of a folder until this process is killed."""
    with RunFolder(folder, {}).lock():
        held.set()
        signal.pause()


@pytest.mark.skipif(sys.platform == "win32", reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # of other threads: none holds the lock
def test_a_run_does_not_start_in_the_folder_of_another(trainer, finished):
    """Nor does it change the files; the lock of a process that was stopped holds, that of a killed one does not."""
    before = {path.name: path.read_bytes() for path in finished.iterdir()}
    context = multiprocessing.get_context("fork")
    held = context.Event()
    first = context.Process(target=hold, args=(finished, held))
    first.start()
    try:
        assert held.wait(60)
        with pytest.raises(ParameterError, match=r"Another run is using `.*run`\."):
            trainer().run()
        assert before == {path.name: path.read_bytes() for path in finished.iterdir()}
        os.kill(first.pid, signal.SIGSTOP)
        with pytest.raises(ParameterError, match="Another run is using"), RunFolder(finished, {}).lock():
            pytest.fail("came in")
    finally:
        first.kill()
        first.join(60)
    with RunFolder(finished, {}).lock():
        pass


@pytest.mark.acceptance  # 6 s, most of it the start; the test above has the lock itself
def test_two_runs_do_not_share_a_folder(photos, calibration, tmp_path, monkeypatch, capsys):
    """While one process trains, a second run may neither start nor change the files."""
    monkeypatch.chdir(tmp_path)
    line = [*command(tmp_path, calibration, photos), "--steps", "1000000"]
    folder, options = tmp_path / "run", {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    first = subprocess.Popen([sys.executable, "-m", "mwdn", *line, "--out", "run"], **options)
    try:
        while not (folder / "state.safetensors").exists():
            with pytest.raises(subprocess.TimeoutExpired):
                first.wait(0.05)
        written = (folder / "log.jsonl").read_text(encoding="utf-8")
        with pytest.raises(SystemExit) as second:
            main([*line, "--out", "run"])
        assert second.value.code == 2
        assert "Another run is using `run`." in capsys.readouterr().err
        assert (folder / "log.jsonl").read_text(encoding="utf-8").startswith(written)
        first.send_signal(signal.SIGSTOP)  # a stopped process still holds the lock
        with pytest.raises(ParameterError, match="Another run is using"), RunFolder(folder, {}).lock():
            pytest.fail("came in")
    finally:
        first.kill()
        first.communicate(timeout=60)
    with RunFolder(folder, {}).lock():  # the killed process holds no lock
        pass


# --- The paper's schedule ------------------------------------------------------------------------------

# The learning rate is too high for the loss to keep falling, so that each phase is reached soon.
PAPER = Recipe(
    {"name": "wiener"},
    Schedule(
        steps=400,
        batch=2,
        lr_schedule="plateau",
        learning_rate=1.0,
        optimiser="adam",
        clip=0.0,
        ema=0.0,
        bfloat16=False,
        validate_every=2,
        validation=3,
    ),
    {"mse": 1.0, "l1": 1.0},
    plateau=Plateau(patience=1, later=1e-2, stop=2e-4),
    later_loss={"mse": 1.0, "l1": 0.05},
)


def test_plateau_switches_phase_and_stops_when_torchs_scheduler_does(whole_paper):
    optim = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    oracle = torch.optim.lr_scheduler.ReduceLROnPlateau(optim, factor=0.1, patience=1)
    lines, phases = log(whole_paper), []
    for line in lines:
        rate = optim.param_groups[0]["lr"]
        assert rate >= 2e-4  # else there should be no such step
        assert line["learning_rate"] == rate
        weight = 1.0 if rate > 1.0001e-2 else 0.05
        assert line["loss"] == pytest.approx(line["mse"] + weight * line["l1"])
        phases.append(weight)
        assert (line["psnr"] is not None) == (line["validation_loss"] is not None) == (line["step"] % 2 == 0)
        if line["validation_loss"] is not None:
            oracle.step(line["validation_loss"])
    assert set(phases) == {1.0, 0.05}
    assert optim.param_groups[0]["lr"] < 2e-4  # stopped by it, not by the number of steps
    assert len(lines) < 400
    assert read_metadata(whole_paper / "last.safetensors")["step"] == len(lines)


def test_plateau_resumes(trainer, whole_paper, tmp_path):
    """Stopped four times: in each phase, right after a validation and in between."""
    for step in (2, 8, 15, 20):
        stop(trainer(PAPER, "parts"), step)
        assert trainer(PAPER, "parts").step == step - step % 2
    last = trainer(PAPER, "parts")
    last.run()
    assert_same_end(tmp_path / "parts", whole_paper)
    again = trainer(PAPER, "parts")
    assert again.lr_schedule == last.lr_schedule
    assert again.lr_schedule.finished
    again.run()
    assert again.step == last.step  # it has ended, though not by the number of steps


def as_of_an_earlier_version(folder):
    """The folder of a run with the former name of `lr_schedule`, in recipe.json and in the state's header."""
    identity = json.loads((folder / "recipe.json").read_text())
    identity["recipe"]["schedule"]["course"] = identity["recipe"]["schedule"].pop("lr_schedule")
    (folder / "recipe.json").write_text(json.dumps(identity))
    path = folder / "state.safetensors"
    tensors, header = read_state(path, path.read_bytes())
    header["course"], header["identity"] = header.pop("lr_schedule"), json.dumps(identity)
    save_file(tensors, path, metadata=header)


def test_a_run_of_an_earlier_version_goes_on(trainer, whole, tmp_path):
    stop(trainer(), 5)
    as_of_an_earlier_version(tmp_path / "run")
    second = trainer()
    assert second.step == 3
    second.run()
    assert_same_end(tmp_path / "run", whole)


def test_the_plateau_of_an_earlier_version_goes_on(trainer, tmp_path):
    """Where it was: `test_plateau_resumes` has what comes after it."""
    stop(trainer(PAPER), 5)
    first = trainer(PAPER)
    as_of_an_earlier_version(tmp_path / "run")
    second = trainer(PAPER)
    assert second.step == first.step == 4
    assert second.lr_schedule == first.lr_schedule
    assert second.lr_schedule.best < float("inf")


def test_weights_of_an_earlier_version_belong_to_the_same_run(trainer, finished):
    """Without a state, recipe.json identifies the run."""
    as_of_an_earlier_version(finished)
    (finished / "state.safetensors").unlink()
    assert trainer().step == 0


@pytest.mark.parametrize("clip", [0.0, 1e-3])
def test_gradients_are_clipped_or_left(trainer, clip):
    run = trainer(few(clip=clip))
    run.advance()
    norm = torch.stack([p.grad.norm() for p in run.network.parameters() if p.grad is not None]).norm()
    assert norm > 0.01 if clip == 0 else norm == pytest.approx(1e-3, rel=1e-3)


# --- Recorded pairs -----------------------------------------------------------------------------------


@pytest.fixture
def pairs(photos, calibration, tmp_path):
    path = tmp_path / "pairs.h5"
    simulate(RECIPE, calibration, photos=photos, out=path, count=23)
    return path


def test_epochs_of_recorded_pairs(pairs, calibration, tmp_path):
    """23 pairs: 2 for test, 2 for validation, 19 for training, which are 5 steps of 4."""
    run = prepare(few(epochs=2, batch=4), calibration, pairs=pairs, out=tmp_path / "run", device="cpu")
    assert (run.schedule.steps, run.schedule.validate_every, run.schedule.validation) == (10, 5, 2)
    seen = []
    read = PairFile.__getitem__
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(PairFile, "__getitem__", lambda self, row: (seen.append(row), read(self, row))[1])
        run.run()
    training = [row for row in seen if row >= 4]
    assert sorted(training[:19]) == sorted(training[19:38]) == list(range(4, 23))
    assert [row for row in seen if row < 4] in ([2, 3] * 2, [3, 2] * 2)
    assert [line["step"] for line in log(tmp_path / "run") if line["psnr"] is not None] == [5, 10]


def test_run_on_photographs_is_not_resumed_with_pairs(finished, pairs, calibration):
    with pytest.raises(CheckpointError, match="or on other pairs"):
        prepare(few(validation=3), calibration, pairs=pairs, out=finished, device="cpu")


def test_epochs_of_photographs(trainer):
    assert trainer(few(epochs=4, batch=2)).schedule.steps == 8  # of 3, which are fewer than 20, none is held out


def test_resumed_run_on_recorded_pairs_ends_bit_identical(pairs, calibration, tmp_path):
    def make(folder):
        return prepare(few(steps=7, batch=4), calibration, pairs=pairs, out=tmp_path / folder, device="cpu")

    make("whole").run()
    stop(make("halves"), 5)
    assert make("halves").step == 3  # two steps before the end of the first epoch
    make("halves").run()
    assert_same_end(tmp_path / "halves", tmp_path / "whole")


def test_captures_on_the_sheet_change_nothing_else(whole, photos, calibration, tmp_path):
    np.save(tmp_path / "capture.npy", np.random.default_rng(0).random((32, 32, 3), np.float32))
    (tmp_path / "folder").mkdir()
    np.save(tmp_path / "folder" / "a.npy", np.full((32, 32, 3), 0.5, np.float32))
    for name, capture in (("one", "capture.npy"), ("other", "folder")):
        recipe, out = replace(RECIPE, sheet=Sheet((str(tmp_path / capture),))), tmp_path / name
        prepare(recipe, calibration, photos=photos, out=out, device="cpu").run()
        assert same(whole / "state.safetensors", out / "state.safetensors")
        assert read_metadata(out / "best.safetensors") == read_metadata(whole / "best.safetensors")
    sheets = [cv2.imread(str(run / "validation.png")) for run in (whole, tmp_path / "one", tmp_path / "other")]
    assert sheets[1].shape == sheets[2].shape != sheets[0].shape
    assert (sheets[1] != sheets[2]).any()


def test_capture_that_does_not_fit_is_reported_before_training(calibration, photos, tmp_path):
    np.save(tmp_path / "small.npy", np.ones((30, 32, 3), np.float32))
    recipe = replace(RECIPE, sheet=Sheet((str(tmp_path / "small.npy"),)))
    with pytest.raises(ShapeError, match="same height and width"):
        prepare(recipe, calibration, photos=photos, out=tmp_path / "run", device="cpu")


# --- Errors -------------------------------------------------------------------------------------------


def test_another_recipe_or_psf_in_the_same_folder(trainer, finished, photos, calibration, tmp_path):
    before = {path.name: path.read_bytes() for path in finished.iterdir()}
    other = Calibration(calibration.psf.flip(-1))
    for again, said in (
        (lambda: trainer(few(learning_rate=1e-4)), "`schedule.learning_rate` is 0.002 there, 0.0001 here"),
        (lambda: prepare(RECIPE, other, photos=photos, out=tmp_path / "run", device="cpu"), calibration.psf_hash),
    ):
        with pytest.raises(
            CheckpointError, match=f"holds a run of another recipe or PSF.*{said}.*Choose another folder"
        ):
            again()
    assert before == {path.name: path.read_bytes() for path in finished.iterdir()}


def test_weights_of_another_run_are_not_replaced(trainer, finished):
    """Not even if its large state was removed. Without weights, nothing can be lost."""
    folder = finished
    (folder / "state.safetensors").unlink()
    best = (folder / "best.safetensors").read_bytes()
    with pytest.raises(CheckpointError, match="holds a run of another recipe"):
        trainer(few(learning_rate=1e-4))
    assert (folder / "best.safetensors").read_bytes() == best
    assert trainer().step == 0
    for path in folder.glob("*.safetensors"):
        path.unlink()
    assert trainer(few(learning_rate=1e-4)).step == 0


def test_files_of_others_are_not_replaced(trainer, tmp_path):
    (log,) = touch(tmp_path / "run", "log.jsonl")
    log.write_text("my diary")
    with pytest.raises(ParameterError, match=r"log\.jsonl` was not written by this command and would be lost"):
        trainer().run()
    assert log.read_text() == "my diary"


def test_a_folder_of_somebody_else_is_not_removed(trainer, tmp_path):
    """At its end, a run removed everything in the folder `samples`, whoever had put it there."""
    samples = tmp_path / "run" / "samples"
    mine = touch(samples, "a.tif", "000001.safetensors") + touch(samples / (16 * "a"), "notes.txt")
    cached = touch(samples / (16 * "b"), "000001.safetensors")
    trainer(few(pool=4, steps=1)).run()
    assert [path.exists() for path in (*mine, *cached)] == [True, True, True, False]


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
def test_a_pipe_or_a_huge_file_in_place_of_the_state(trainer, tmp_path):
    state = tmp_path / "run" / "state.safetensors"
    state.parent.mkdir()
    os.mkfifo(state)
    with pytest.raises(CheckpointError, match="is a pipe"):
        trainer()
    state.unlink()
    state.touch()
    os.truncate(state, 2**40)  # sparse
    with pytest.raises(CheckpointError, match=r"is damaged: .* Remove it"):
        trainer()


def test_damaged_or_foreign_state(trainer, finished):
    state = finished / "state.safetensors"
    whole = state.read_bytes()
    state.write_bytes(whole[:1000])
    with pytest.raises(CheckpointError, match=r"state\.safetensors` is damaged: .* Remove it"):
        trainer()
    state.write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"state\.safetensors` is damaged"):
        trainer()
    tensors, header = read_state(state, whole)
    del tensors["average.decoder.head.weight"]
    save_file(tensors, state, metadata=header)
    with pytest.raises(CheckpointError, match=r"state\.safetensors` is damaged: a part is missing"):
        trainer()
    state.write_bytes((finished / "last.safetensors").read_bytes())
    with pytest.raises(CheckpointError, match="another recipe or PSF"):
        trainer()


def test_folder_that_cannot_be_written_is_reported_before_training(trainer, tmp_path):
    (tmp_path / "run").write_text("a file")
    with pytest.raises(ParameterError, match=r"`.*run` must be a folder that can be written to: .*`out`"):
        trainer()
    with pytest.raises(ParameterError, match="must be a folder that can be written to"):
        trainer(folder="run/deeper")
    assert (tmp_path / "run").read_text() == "a file"


@pytest.mark.parametrize("refused", ["last.safetensors", "best.safetensors", "state.safetensors"])
def test_full_disk_leaves_the_state(trainer, whole, tmp_path, monkeypatch, refused):
    """Whichever of the three files of a checkpoint cannot be written."""
    run, folder = trainer(), tmp_path / "run"
    for _ in range(3):
        run.advance()
    run.save(Validation(-100.0, 1.0))
    before = (folder / "state.safetensors").read_bytes()
    rename = Path.replace

    def full(path, target):
        if target.name == refused:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(ParameterError, match=r"`.*run` must be .*: No space left on device\. Make room and give the"):
        run.run()
    monkeypatch.undo()
    assert (folder / "state.safetensors").read_bytes() == before
    assert not list(folder.glob(".*"))
    for name in ("last", "best"):
        load_checkpoint(folder / f"{name}.safetensors")
    trainer().run()
    assert same(folder / "state.safetensors", whole / "state.safetensors")


def test_divergence_leaves_the_state(trainer, tmp_path):
    run = trainer(few(steps=9))
    advance(run)
    before = (tmp_path / "run" / "state.safetensors").read_bytes()
    with torch.no_grad():
        next(run.network.parameters()).fill_(float("nan"))
    with pytest.raises(DivergenceError, match=r"The loss of step 3 \(samples 6 to 7\) is not finite\. Lower the"):
        run.run()
    assert (tmp_path / "run" / "state.safetensors").read_bytes() == before
    assert trainer(few(steps=9)).step == 3


def test_divergence_in_the_validation(trainer, tmp_path):
    """It is reported before a picture or weights are written."""
    run = trainer(few(steps=1, validate_every=1, warmup=0, learning_rate=1e18, clip=0.0, bfloat16=False))
    with pytest.raises(DivergenceError, match="The loss of the validation after step 1 is not finite"):
        run.run()
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {"recipe.json", "log.jsonl"}


@pytest.mark.parametrize("seed", [-(2**62), 2**63 - 1])
def test_any_seed(trainer, seed):
    recipe = few(steps=1, seed=seed, pool=2)
    trainer(recipe).run()
    trainer(replace(recipe, schedule=replace(recipe.schedule, crop=16), cameras=Cameras(("32x32",))), "many").run()


def test_divergence_names_recorded_rows_and_the_way_out(pairs, calibration, tmp_path):
    run = prepare(few(seed=1), calibration, pairs=pairs, out=tmp_path / "run", device="cpu")
    rows = [run.task.samples.pairs.row(number) for number in range(2)]
    with torch.no_grad():
        next(run.network.parameters()).fill_(float("nan"))
    said = rf"samples 0 to 1, rows {re.escape(str(rows))} of the file\) is not finite\. .* another folder, `out`\.$"
    with pytest.raises(DivergenceError, match=said):
        run.advance()
    run.save(Validation(0.0, 0.0))
    with pytest.raises(DivergenceError, match=r'are kept: `start = ".*last\.safetensors"`\.$'):
        run.advance()


def test_a_network_that_cannot_learn_from_the_samples(photos, tmp_path):
    """BatchNorm needs more than one number, and a U-Net more than a few pixels."""
    tiny = Calibration(torch.eye(16).expand(1, 3, -1, -1) / 16)
    recipe = replace(few(batch=1), network={"name": "mwdn", "width": 4})
    with pytest.raises(
        ParameterError, match=r"\[network\] .* cannot learn from a batch of 1 of these samples: Expected"
    ):
        prepare(recipe, tiny, photos=photos, out=tmp_path / "run", device="cpu").advance()


# --- Across cameras, and from known weights -----------------------------------------------------------


def test_a_network_for_all_cameras_has_no_psf_hash(trainer, tmp_path):
    recipe = replace(few(steps=3), cameras=Cameras(("32x32", "32x48")))
    trainer(recipe).run()
    assert read_metadata(tmp_path / "run" / "last.safetensors")["psf_hash"] is None


def test_a_run_starts_from_given_weights(trainer, tmp_path):
    trainer(few(steps=3)).run()
    start = str(tmp_path / "run" / "last.safetensors")
    first = trainer(few(start=start), "second").network
    weights = load_checkpoint(start)
    assert all(
        torch.equal(a, b) for a, b in zip(first.state_dict().values(), weights.state_dict().values(), strict=True)
    )
    wider = replace(few(start=start), network={**RECIPE.network, "width": 8})
    with pytest.raises(CheckpointError, match="must hold the network of the recipe") as error:
        trainer(wider, "third")
    assert len(str(error.value).splitlines()) == 1


def test_a_resumed_run_with_a_cache_ends_as_an_unbroken_one(trainer, tmp_path):
    pooled = few(pool=4)
    trainer(pooled, "whole").run()
    advance(trainer(pooled, "stopped"))
    trainer(pooled, "stopped").run()
    assert same(tmp_path / "whole" / "last.safetensors", tmp_path / "stopped" / "last.safetensors")


def stop_after(samples):
    """A callback that presses Ctrl-C after so many samples."""

    def show(done, total):
        if done == samples:
            signal.raise_signal(signal.SIGINT)

    return show


def computed(run):
    """Numbers of the samples that a run computes."""
    first, numbers = [], []
    run.run(samples=lambda done, total: numbers.append(done) or first.append(total - done))
    return first[0], numbers


def test_interrupted_samples_are_kept_until_the_run_ends(trainer, tmp_path):
    pooled = few(pool=8, steps=5)
    trainer(pooled, "whole").run()
    with pytest.raises(KeyboardInterrupt, match=r"after 3 of 8 samples\."):
        trainer(pooled, "stopped").run(samples=stop_after(3))
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "stopped" / "samples").glob("*/*")}
    assert len(kept) == 3
    with pytest.raises(KeyboardInterrupt, match=r"after step 1\."):
        trainer(pooled, "stopped").run(lambda report: signal.raise_signal(signal.SIGINT))
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert computed(trainer(pooled, "stopped"))[0] == 0
    for name in ("last", "state"):
        assert same(tmp_path / "whole" / f"{name}.safetensors", tmp_path / "stopped" / f"{name}.safetensors")
    assert not (tmp_path / "stopped" / "samples").exists()


def test_only_samples_that_the_steps_use_are_computed(trainer):
    assert computed(trainer(few(pool=8, steps=3))) == (6, [0, 1, 2, 3, 4, 5, 6])


@pytest.mark.parametrize("changed", ["photographs", "recipe"])
def test_samples_of_others_are_not_used(trainer, photos, tmp_path, changed):
    pooled = few(pool=4, steps=2)
    with pytest.raises(KeyboardInterrupt):
        trainer(pooled).run(samples=stop_after(3))
    other = replace(pooled, sensor=Sensor(full_well=99.0)) if changed == "recipe" else pooled
    if changed == "photographs":
        cv2.imwrite(str(photos / "3.png"), np.full((24, 24, 3), 99, np.uint8))
    with pytest.raises(KeyboardInterrupt, match="after 1 of 4"):
        trainer(other).run(samples=stop_after(1))
    assert len(list((tmp_path / "run" / "samples").glob("*/*"))) == 1


def test_samples_are_not_kept_on_a_disk_without_room(trainer, tmp_path, monkeypatch):
    free = shutil.disk_usage(tmp_path)._replace(free=10_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: free)
    with pytest.raises(KeyboardInterrupt):
        trainer(few(pool=4, steps=2)).run(samples=stop_after(3))
    assert not (tmp_path / "run" / "samples").exists()


def test_a_denoiser_of_grey_scenes(trainer):
    """Its scenes kept their colours, and the first step failed."""
    grey = replace(few(steps=1), network=DRUNET | {"channels": 1}, denoising=Denoising((0.05, 0.1)))
    run = trainer(grey, "a")
    assert run.task.samples.batch(range(2)).scene.shape[1] == 1
    run.run()


def test_a_denoiser_is_trained_alone_and_then_frozen(trainer, tmp_path):
    """Trained on noisy scenes, then part of a network whose U-Net learns, with a cache or without."""
    alone = few(steps=12, learning_rate=3e-3, validate_every=12)
    learned = trainer(replace(alone, network=DRUNET, denoising=Denoising((0.05, 0.1))), "a")
    noisy, scene, level = learned.task.samples.batch(range(10**6, 10**6 + 8))  # not trained on

    def error(denoiser):
        with torch.no_grad():
            return (denoiser(noisy, level) - scene).square().mean()

    untrained = error(learned.network)
    learned.run()
    assert error(load_checkpoint(tmp_path / "a" / "best.safetensors")) < 0.8 * untrained

    denoiser = load_checkpoint(tmp_path / "a" / "best.safetensors").state_dict()
    for name, pool in (("kept", 4), ("new", 0)):
        recipe = few(steps=2, denoiser=str(tmp_path / "a" / "best.safetensors"), pool=pool)
        second = trainer(replace(recipe, network={**RECIPE.network, "finest": 1, "rounds": 2}), name)
        head = second.network.decoder.head.weight.clone()
        second.run()
        assert not torch.equal(second.network.decoder.head.weight, head)
        for key, value in load_checkpoint(tmp_path / name / "last.safetensors").denoiser.state_dict().items():
            torch.testing.assert_close(value, denoiser[key])

    with pytest.raises(CheckpointError, match=r"`denoiser` \('.*best.safetensors'\) its denoiser, if it has one"):
        trainer(few(denoiser=str(tmp_path / "a" / "best.safetensors")), "none")
    with pytest.raises(CheckpointError, match="holds a denoiser"):
        find_method(tmp_path / "a" / "best.safetensors")


def test_a_denoiser_does_not_learn_from_recorded_pairs(calibration, tmp_path):
    recipe = replace(few(), network=DRUNET, denoising=Denoising((0.05, 0.1)))
    with pytest.raises(ParameterError, match="makes its own pairs from photographs: give `photos`"):
        prepare(recipe, calibration, pairs=tmp_path / "none.h5", out=tmp_path / "run", device="cpu")
