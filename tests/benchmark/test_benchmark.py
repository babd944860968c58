"""A benchmark from its recipe to its page, killed on the way, on a camera of 48 x 64 pixels."""

import contextlib
import csv
import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors import safe_open

from cameras import contour_psf
from mwdn.benchmark import Watch, read_benchmark, run, scoring
from mwdn.benchmark.dataset_recipe import DatasetRecipe
from mwdn.benchmark.recipe import Robustness
from mwdn.benchmark.robustness import check_axes
from mwdn.benchmark.sets import Dataset, open_dataset
from mwdn.benchmark.training import schedule_on, seconds, train
from mwdn.calibration import Calibration
from mwdn.calibration.camera_file import write_camera
from mwdn.calibration.places import field_camera
from mwdn.cli.app import main
from mwdn.data import recorded
from mwdn.data.pair_checks import REFINED
from mwdn.data.pairs import PairFile
from mwdn.data.recorded import Division, RecordedPairs
from mwdn.data.simulated import Placement
from mwdn.errors import CheckpointError, ParameterError, UnknownNameError
from mwdn.evaluation import Perceptual, alexnet, bootstrap
from mwdn.fourier import convolve
from mwdn.optics import Deviation, Sensor
from mwdn.solvers import align
from mwdn.training.recipe import Schedule
from mwdn.weights.checkpoint import read_metadata

RECIPE = """
title = "Two networks & a solver"
ablation = ["wiener", "mwdn"]
compared = "mwdn"
shown = 2
alexnet = "nowhere.pth"
networks = { wiener = {}, mwdn = {} }
solvers = { quick = { name = "admm", iterations = 3 } }
shared.network = { width = 2 }
shared.data = { photos = "photos", test_photos = "test", background = 0.0 }
schedule = { steps = 6, batch = 2, validate_every = 2, warmup = 0, bfloat16 = false }
robustness = { data = "caustic", count = 2, noise = [2], shift_px = [1] }

[data]
caustic = { psf = "psf.npy", train = 4, validation = 2, test = 3, deviation = { turn_degrees = 1, off_axis = 1 } }
"""


def laid_out(folder):
    """psf.npy, photos, test, r.toml."""
    psf = contour_psf((48, 64), cell=12, generator=torch.Generator().manual_seed(5)).expand(1, 3, -1, -1)
    np.save(folder / "psf.npy", (0.9 * psf / psf.max())[0].movedim(0, -1).numpy())
    for number in range(24):
        part = folder / ("photos" if number < 21 else "test")
        part.mkdir(exist_ok=True)
        small = np.random.default_rng(number).integers(0, 256, (4, 4, 3), np.uint8)
        cv2.imwrite(str(part / f"{number}.png"), cv2.resize(small, (24, 24), interpolation=cv2.INTER_CUBIC))
    (folder / "r.toml").write_text(RECIPE, encoding="utf-8")
    return folder


@pytest.fixture
def folder(tmp_path):
    return laid_out(tmp_path)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The output of `mwdn benchmark`, come to its end; tests may add to it."""
    folder = laid_out(tmp_path_factory.mktemp("done"))
    shown = StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(shown), pytest.raises(SystemExit) as stopped:
        main(["benchmark", "r.toml", "--out", "out", "--device", "cpu"])
    assert stopped.value.code == 0
    assert "Look at out/index.html" in shown.getvalue()
    (folder / "first.json").write_text((folder / "out" / "benchmark.json").read_text())
    return folder / "out"


@pytest.fixture
def expected(done):
    """Scores and sweep of a benchmark that nothing stopped."""
    return values(done.parent, "first.json")


def values(out, file="benchmark.json"):
    """All scores and the sweep, without the times."""
    content = json.loads((out / file).read_text())
    methods = content["sets"]["caustic"]["methods"]
    return {label: result["values"] for label, result in methods.items()}, content["robustness"]


KILLED = """
import os, signal, sys
from pathlib import Path
import torch
torch.set_num_threads(2)
from mwdn.benchmark import read_benchmark, run, scoring
from mwdn.training import trainer

calls = {"save": 0, "measure": 0}
def counted(name, then, last):
    def call(*arguments, **options):
        result = then(*arguments, **options)
        calls[name] += 1
        if calls[name] == last:
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    return call

where = sys.argv[1]
if where == "save":     # the second network has saved once: 1 x 3 + 1
    trainer.Trainer.save = counted("save", trainer.Trainer.save, 4)
else:                   # the second method has been scored, but its scores are not written
    scoring.evaluate = counted("measure", scoring.evaluate, 2)
run(read_benchmark("r.toml"), Path("out"), device="cpu")
"""


def killed(folder, where):
    call = [sys.executable, "-W", "error", "-c", KILLED, where]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.mark.acceptance  # 25 s, three starts; test_kills.py kills at random moments
def test_goes_on_where_it_was_killed(folder, expected, monkeypatch):
    monkeypatch.chdir(folder)
    killed(folder, "save")
    first, second = (folder / "out" / "runs" / "caustic" / label for label in ("wiener", "mwdn"))
    assert len((first / "log.jsonl").read_text().splitlines()) == 6
    assert len((second / "log.jsonl").read_text().splitlines()) == 2
    assert not (folder / "out" / "scores").exists()
    weights = (first / "best.safetensors").stat()
    pairs = (folder / "out" / "data" / "caustic.h5").stat()

    killed(folder, "measure")
    assert len((second / "log.jsonl").read_text().splitlines()) == 6
    scored = {path.name for path in (folder / "out" / "scores" / "caustic").glob("*.json")}
    assert scored == {"quick.json"}
    written = (folder / "out" / "scores" / "caustic" / "quick.json").stat()

    run(read_benchmark("r.toml"), Path("out"), device="cpu")
    assert (first / "best.safetensors").stat().st_mtime_ns == weights.st_mtime_ns
    assert (folder / "out" / "data" / "caustic.h5").stat().st_mtime_ns == pairs.st_mtime_ns
    assert (folder / "out" / "scores" / "caustic" / "quick.json").stat().st_mtime_ns == written.st_mtime_ns

    scores, swept = values(folder / "out")
    wanted, wanted_sweep = expected
    assert scores.keys() == {"quick", "wiener", "mwdn"}
    for label, metrics in wanted.items():
        assert [metric for metric, numbers in metrics.items() if None in numbers] == ["lpips", "feature_mse"]
        for metric in ("psnr", "ssim", "mse"):
            # Training amplifies the last digit, which is not the same in every process.
            assert scores[label][metric] == pytest.approx(metrics[metric], rel=2e-3), (label, metric)
        for axis, sizes in wanted_sweep[label].items():
            for size, numbers in sizes.items():
                assert swept[label][axis][size] == pytest.approx(numbers, rel=2e-3), (label, axis, size)


@pytest.mark.acceptance  # test_locks has the sharing itself, in real processes
def test_two_processes_share_the_networks(folder, expected):
    call = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "mwdn"]
    call += ["benchmark", "r.toml", "--out", "out", "--device", "cpu"]
    ended = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert ended.returncode == 0, ended.stderr
    scores, wanted = values(folder / "out")[0], expected[0]
    for label in ("quick", "wiener", "mwdn"):
        assert scores[label]["psnr"] == pytest.approx(wanted[label]["psnr"], rel=2e-3), label
    for label in ("wiener", "mwdn"):
        log = (folder / "out" / "runs" / "caustic" / label / "log.jsonl").read_text()
        assert len(log.splitlines()) == 6, label


def test_the_page_holds_all_results(done):
    page = (done / "index.html").read_text()
    assert "<title>Two networks &amp; a solver</title>" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page), "the page must need no other file"
    content = json.loads((done / "benchmark.json").read_text())
    dataset = content["sets"]["caustic"]
    assert (dataset["protocol"], dataset["variant"]) == ("full", "clipped")
    assert dataset["data"]["deviation"]["turn_degrees"] == 1.0
    assert {"lpips", "feature_mse"} <= dataset["missing"].keys()
    lines = {row["method"]: row for row in csv.DictReader((done / "benchmark.csv").read_text().splitlines())}
    assert list(lines) == ["quick", "wiener", "mwdn"]
    markdown = (done / "benchmark.md").read_text()
    for label, scores in dataset["methods"].items():
        mean, low, high = bootstrap(scores["values"]["psnr"])
        assert f"{mean:.2f}" in markdown
        assert f"[{low:.2f}, {high:.2f}]" in page
        assert float(lines[label]["psnr"]) == pytest.approx(mean)
        assert lines[label]["lpips"] == ""
        assert int(lines[label]["learnable"]) == scores["learnable"]
        assert (scores["training_seconds"] is None) == (label == "quick")
    assert dataset["methods"]["wiener"]["learnable"] == 2
    for name in re.findall(r"\(pictures/([^)]+)\)", markdown):
        picture = cv2.imread(str(done / "pictures" / name))
        assert picture.std() > 5, name
    assert {"caustic.jpg", "caustic-curves.png", "robustness-mwdn.png"} <= {
        p.name for p in (done / "pictures").iterdir()
    }
    for word in ("torch", "iterations = 3", "The command:", "mwdn minus its", "off_axis 1"):
        assert word in page


def test_the_test_part_is_no_part_of_the_training(done):
    """21 photographs and 3 others: 4 pairs to learn from, then 2 of held-out photographs, then 3 of the others."""
    file = PairFile(done / "data" / "caustic.h5")
    assert len(file) == 4 + 2 + 3
    scenes = [file[i][1] for i in range(9)]
    for i in range(9):
        assert not any(scenes[i].equal(scenes[j]) for j in range(i))


def test_checkpoints_say_which_simulated_pairs_they_were_trained_on(done):
    """They said 8:1:1 with the test first, so `mwdn evaluate` recommended pairs of the training as a test."""
    metadata = read_metadata(done / "runs" / "caustic" / "mwdn" / "best.safetensors")
    division, count = Division(**metadata["recipe"]["pairs"]), len(PairFile(done / "data" / "caustic.h5"))
    parts = division.parts(count)
    assert [*parts["train"]] == [*range(4)]
    assert [*parts["test"]] == [*range(count - 3, count)]
    assert metadata["pairs"] == f"4 of {count} recorded"


@pytest.mark.parametrize(
    ("before", "after", "kind"),
    [("turn_degrees = 1", "turn_degrees = 2", ParameterError), ("steps = 6", "steps = 8", CheckpointError)],
)
def test_another_recipe_needs_another_folder(done, before, after, kind):
    path = done.parent / "other.toml"
    path.write_text(RECIPE.replace(before, after), encoding="utf-8")
    with pytest.raises(kind, match="another recipe"):
        run(read_benchmark(path), done, device="cpu")


def test_the_name_of_the_recipe_does_not_matter(done, monkeypatch):
    """Nor that of the folder it is called from: the same files are the same data."""
    monkeypatch.chdir(done)
    relative, absolute = read_benchmark("../r.toml"), read_benchmark(done.parent / "r.toml")
    assert relative.data == absolute.data


@pytest.mark.acceptance
def test_another_method_and_another_set_are_a_line_each(done):
    folder = done.parent
    more = RECIPE.replace("mwdn = {} }", 'mwdn = {}, plain = { name = "unet" } }')
    more = more.replace("iterations = 3 } }", "iterations = 3 }, universal-small = {} }")
    more += 'real = { psf = "psf.npy", pairs = "out/data/caustic.h5", trained_on = "caustic", test = 2 }\n'
    (folder / "more.toml").write_text(more, encoding="utf-8")
    before = (done / "runs" / "caustic" / "mwdn" / "best.safetensors").stat().st_mtime_ns
    results = run(read_benchmark(folder / "more.toml"), done, device="cpu")
    assert (done / "runs" / "caustic" / "mwdn" / "best.safetensors").stat().st_mtime_ns == before
    assert list(results.methods["real"]) == ["quick", "universal-small", "wiener", "mwdn", "plain"]
    assert results.methods["real"]["universal-small"].scores.learnable > 1e6  # trained, but not here
    assert results.report("real").pictures == 2
    assert not (done / "runs" / "real").exists()
    assert results.training_seconds("real", "plain") == results.training_seconds("caustic", "plain")


@pytest.mark.parametrize(
    ("before", "after", "kind", "message"),
    [
        ("mwdn = {} }", "mwdm = {} }", UnknownNameError, "Did you mean 'mwdn'?"),
        ("mwdn = {} }", "mwdn = { widht = 3 } }", UnknownNameError, "Did you mean 'width'?"),
        ("iterations = 3 } }", "iterations = 3 }, universal = { width = 3 } }", UnknownNameError, "width"),
        ("mwdn = {} }", "mwdn = 3 }", ParameterError, "must be a table of options"),
        ("iterations = 3 } }", "iterations = -3 } }", ParameterError, r"\[solvers\..*\]: `iterations` \(-3\)"),
        (
            "mwdn = {} }",
            "'../../ESC' = { name = 'mwdn' } }",
            ParameterError,
            r"label .*'\.\./\.\./ESC'.* name of a folder",
        ),
        ("caustic = {", "'a/b' = {", ParameterError, r"label .*'a/b'.* name of a folder"),
        ("quick = { name", "wiener = { name", ParameterError, r"`wiener` .*\[networks\] and in \[solvers\]"),
        ('compared = "mwdn"', 'compared = "unet"', UnknownNameError, "method of this recipe"),
        ('compared = "mwdn"', 'compered = "mwdn"', UnknownNameError, "Did you mean 'compared'?"),
        ('compared = "mwdn"', "compared = 3", ParameterError, "must be text"),
        ("off_axis = 1 }", "of_axis = 1 }", UnknownNameError, "Did you mean 'off_axis'?"),
        ("off_axis = 1 }", "off_axis = -1 }", ParameterError, "must be from 0 to 3.3"),
        ("train = 4", "train = -4", ParameterError, "at least 0"),
        ('psf = "psf.npy", ', "", ParameterError, "must name a PSF"),
        ('test_photos = "test"', 'test_photos = "photos"', ParameterError, "share no photograph"),
        ('test_photos = "test"', 'test_photos = "photos/test"', ParameterError, "share no photograph"),
        ('psf = "psf.npy"', 'psf = "$MWDN_NOWHERE/psf.npy"', ParameterError, "`MWDN_NOWHERE`.*is not set"),
        ('data = "caustic", ', "", ParameterError, r"\[robustness\] \(noise, shift_px\).*`data = \"caustic\"`"),
        ("noise = [2]", "noise = []", ParameterError, "must be a list of numbers"),
        ("noise = [2]", "noise = [true]", ParameterError, "must be a list of numbers"),
        ("noise = [2]", "noise = [inf]", ParameterError, r"`noise` \(inf\) must be finite"),
        ("networks = { wiener = {}, mwdn = {} }", "networks = 5", ParameterError, r"`networks` \(5\) must be a table"),
        ("deviation = { turn_degrees = 1, off_axis = 1 }", "deviation = 5", ParameterError, "deviation.* be a table"),
        ("mwdn = {} }", 'mwdn = { name = ["a"] } }', UnknownNameError, "network"),
        ("mwdn = {} }", "mwdn = { schedule = 5 } }", ParameterError, r"`networks\.mwdn\.schedule` \(5\)"),
        ("networks = {", "loss = 5\nnetworks = {", ParameterError, r"`loss` \(5\) must be a table"),
        ("shared.network = { width = 2 }", "shared.network = 5", ParameterError, r"`shared\.network` \(5\)"),
        ('alexnet = "nowhere.pth"', "alexnet = 5", ParameterError, r"`alexnet`.*\(5\) must be text"),
        ("noise = [2]", "nois = [2]", UnknownNameError, "Did you mean 'noise'?"),
        ('data = "caustic"', 'data = "castic"', UnknownNameError, "Did you mean 'caustic'?"),
        ("test = 3", 'test = 3, pairs = "a.h5"', ParameterError, "`split`.*`trained_on`"),
    ],
)
def test_mistakes_of_a_recipe(tmp_path, before, after, kind, message):
    assert before in RECIPE
    (tmp_path / "r.toml").write_text(RECIPE.replace(before, after, 1), encoding="utf-8")
    with pytest.raises(kind, match=message):
        read_benchmark(tmp_path / "r.toml")


def test_a_renamed_key_still_works_and_warns(tmp_path):
    def read(text):
        (tmp_path / "r.toml").write_text(RECIPE.replace("off_axis = 1 }", f"off_axis = 1, {text} = 0.2 }}"))
        return read_benchmark(tmp_path / "r.toml")

    new = read("haze")
    with pytest.warns(FutureWarning, match=r"`background` of .* is now called `haze`"):
        assert read("background") == new
    assert new.data["caustic"].deviation.haze == 0.2


def test_epochs_are_steps_of_each_data_set(tmp_path):
    """Five pairs are three steps of two; a source without end has no epochs."""
    plateau = "epochs = 4, lr_schedule = 'plateau', clip = 0.0"
    tail = "\n[plateau]\nlater = 1e-5\n[later_loss]\nmse = 0.5\n"
    (tmp_path / "r.toml").write_text(RECIPE.replace("steps = 6", plateau) + tail, encoding="utf-8")
    benchmark = read_benchmark(tmp_path / "r.toml")
    assert (benchmark.plateau.later, benchmark.later_loss) == (1e-5, {"mse": 0.5})
    dataset = object.__new__(Dataset)
    object.__setattr__(dataset, "training", (range(5), None))
    schedule = schedule_on(benchmark.methods[-1], benchmark, dataset)
    assert (schedule.steps, schedule.validate_every, schedule.batch) == (12, 3, 2)
    endless = RECIPE.replace("steps = 6", plateau).replace("train = 4", "train = 0")
    (tmp_path / "r.toml").write_text(endless, encoding="utf-8")
    with pytest.raises(ParameterError, match=r"`epochs`.*`caustic`.*`steps`"):
        read_benchmark(tmp_path / "r.toml")


@pytest.mark.parametrize("changed", ["train = 0", 'train = 4, trained_on = "caustic"'])
def test_the_mean_picture_needs_training_pairs(tmp_path, changed):
    text = RECIPE.replace("shown = 2", "mean_picture = true").replace("train = 4", changed)
    (tmp_path / "r.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ParameterError, match=r"`mean_picture`.*`caustic`.*`train`"):
        read_benchmark(tmp_path / "r.toml")


@pytest.mark.acceptance
def test_rates_seeds_mismatch_and_the_mean_picture(tmp_path):
    """Each network is trained at the better of two rates; the mean of the training scenes is a row."""
    folder = laid_out(tmp_path)
    text = RECIPE.replace('robustness = { data = "caustic", count = 2, noise = [2], shift_px = [1] }', "")
    text = text.replace(
        "networks = { wiener = {}, mwdn = {} }",
        "networks = { wiener = { schedule = { seed = 7 } }, own = { name = 'wiener', schedule.learning_rate = 0.5 } }",
    )
    text = text.replace('ablation = ["wiener", "mwdn"]', "rates = [1e-3, 1e-2]\ntrial = 0.5\nmean_picture = true")
    text = text.replace("deviation = { turn_degrees = 1, off_axis = 1 }", "mismatch = { tails = 0.1 }")
    text = text.replace('compared = "mwdn"', "")
    (folder / "r.toml").write_text(text, encoding="utf-8")
    benchmark = read_benchmark(folder / "r.toml")
    run(benchmark, folder / "out", device="cpu", lpips=False)
    runs = folder / "out" / "runs" / "caustic" / "wiener"
    recipes = {
        part: json.loads((runs / part / "recipe.json").read_text())["recipe"]["schedule"]
        for part in (".", "rate-0.001", "rate-0.01")
    }
    psnr = {part: read_metadata(runs / part / "best.safetensors")["psnr"] for part in recipes}
    assert {(s["steps"], s["seed"]) for part, s in recipes.items() if part != "."} == {(3, 7)}
    assert (recipes["."]["steps"], recipes["."]["seed"]) == (6, 7)
    own = runs.with_name("own")  # has a rate of its own
    assert json.loads((own / "recipe.json").read_text())["recipe"]["schedule"]["learning_rate"] == 0.5
    assert not [*own.glob("rate-*")]
    better = max(("rate-0.001", "rate-0.01"), key=lambda part: psnr[part])
    assert recipes["."]["learning_rate"] == recipes[better]["learning_rate"]
    pairs = PairFile(folder / "out" / "data" / "caustic.h5")
    mean = torch.stack([pairs[row][1] for row in range(4)]).mean(0)
    expected = [-10 * (pairs[row][1] - mean.clamp(0, 1)).square().mean().log10().item() for row in (6, 7, 8)]
    assert values(folder / "out")[0]["mean picture"]["psnr"] == pytest.approx(expected, abs=1e-3)
    assert "mismatch" in json.loads((folder / "out" / "data" / "caustic.json").read_text())


def test_a_camera_file_says_what_a_data_set_does_not(tmp_path):
    """Its dark frame, gamma, crop and own bin of the PSF had no keys here, so such a camera could not be compared."""
    frame = np.random.default_rng(0).integers(8, 200, (32, 48, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "psf.png"), frame)
    cv2.imwrite(str(tmp_path / "dark.png"), np.full_like(frame, 8))
    content = {"psf": tmp_path / "psf.png", "dark": tmp_path / "dark.png", "background": 0.0, "psf_gamma": 2.2}
    content |= {"crop": (16, 24), "bin": 2, "psf_bin": 2, "white_balance": (2.0, 1.0, 1.0), "upside_down": True}
    write_camera(tmp_path / "camera.toml", content)
    names = 'photos = "photos", test_photos = "test"'
    for line, options in (
        ("", {}),
        ("upside_down = false, background = 0.01,", {"upside_down": False, "background": 0.01}),
    ):
        data = f'[data]\nown = {{ camera = "camera.toml", {line} {names} }}\n'
        (tmp_path / "r.toml").write_text("networks = { mwdn = {} }\n" + data, encoding="utf-8")
        recipe = read_benchmark(tmp_path / "r.toml").data["own"]
        calibration, wanted = recipe.calibration(), Calibration.load(tmp_path / "camera.toml", **options)
        assert calibration.psf_hash == wanted.psf_hash
        assert calibration.frames == wanted.frames
        assert torch.equal(calibration.dark, wanted.dark)
        assert calibration.white_balance is None
        assert recipe.bin == 2
    (tmp_path / "camera.toml").write_text('psf = "psf.png"\nbins = 3\n', encoding="utf-8")
    with pytest.raises(UnknownNameError, match="Did you mean 'bin'"):
        read_benchmark(tmp_path / "r.toml")


def test_captures_have_the_noise_that_the_camera_file_holds(folder):
    """Binned by 2, a pixel has 4 times the electrons and twice the read noise of one of the sensor's."""
    content = {"psf": folder / "psf.npy", "background": 0.0, "bin": 2}
    content |= {"full_well_electrons": 400.0, "read_noise_electrons": 5.0}
    write_camera(folder / "camera.toml", content)
    recipe = DatasetRecipe(camera=str(folder / "camera.toml"), psf=str(folder / "psf.npy"), bin=2, psf_bin=0)
    recipe = replace(recipe, photos=str(folder / "photos"), test_photos=str(folder / "test"), train=1, test=1)
    for own, wanted in ((Sensor(), (1600.0, 10.0)), (Sensor(full_well=900.0), (900.0, Sensor().read_noise))):
        name = f"noise-{own.full_well:g}"
        dataset = open_dataset(name, replace(recipe, sensor=own), folder, torch.device("cpu"), lambda _, rows: rows)
        assert (dataset.recipe.sensor.full_well, dataset.recipe.sensor.read_noise) == pytest.approx(wanted)
        assert dataset.identity["sensor"]["full_well"] == pytest.approx(wanted[0])


@pytest.mark.parametrize("simulated", [False, True])
def test_pairs_have_the_refinement_that_they_lack(folder, simulated):
    """Pairs of `mwdn simulate` were made without stray light; recorded ones lose the 5 % that the camera adds."""
    content = {"psf": folder / "psf.npy", "background": 0.0, "stray_light": ((0.05,),), "sensor_field": ((0.5,),)}
    write_camera(folder / "camera.toml", content)
    shape, marked = (48, 64, 3), {REFINED: "simulate"} if simulated else {}
    with PairFile.create(folder / "p.h5", measurement_shape=shape, scene_shape=shape, attributes=marked) as file:
        file.append(torch.full((10, 3, 48, 64), 0.3), torch.ones(10, 3, 48, 64))
    recipe = DatasetRecipe(camera=str(folder / "camera.toml"), psf=str(folder / "psf.npy"), psf_bin=0)
    recipe = replace(recipe, pairs=str(folder / "p.h5"), split="random")
    dataset = open_dataset("p", recipe, folder, torch.device("cpu"), lambda _, rows: rows)
    wanted = 0.3 if simulated else (0.3 - 0.05) / 0.5
    for measurement in (dataset.test[0][0], *(part.batch([0]).measurement for part in dataset.training)):
        assert measurement.numpy() == pytest.approx(wanted, abs=1e-3)


def opened(folder, camera, **changes):
    """A data set of a camera file, and what its pairs depend on."""
    write_camera(folder / "camera.toml", {"psf": folder / "psf.npy", "background": 0.0, **camera})
    recipe = DatasetRecipe(camera=str(folder / "camera.toml"), psf=str(folder / "psf.npy"), psf_bin=0, background=0.0)
    recipe = replace(recipe, **changes)
    name = f"set-{len(list(folder.glob('set-*')))}"
    return open_dataset(name, recipe, folder, torch.device("cpu"), lambda _, rows: rows)


def ten_pairs(folder, picture):
    """pairs/captures and pairs/scenes, which hold the picture ten times each."""
    for place in ("captures", "scenes"):
        (folder / "pairs" / place).mkdir(parents=True)
        for number in range(10):
            cv2.imwrite(str(folder / "pairs" / place / f"{number}.png"), picture)


def test_imported_captures_lose_the_dark_frame_of_the_camera(folder):
    """Without a word they were scored, and trained on, with the light that the sensor shows without any."""
    capture = np.random.default_rng(0).integers(90, 200, (48, 64, 3), np.uint8)
    ten_pairs(folder, capture)
    cv2.imwrite(str(folder / "dark.png"), np.full((48, 64, 3), 51, np.uint8))
    np.save(folder / "flat.npy", np.full((48, 64, 1), 1.25, np.float32))
    changes = {"kind": "folders", "pairs": str(folder / "pairs"), "split": "random"}
    files = {"dark": folder / "dark.png", "flat_field": folder / "flat.npy"}
    dataset = opened(folder, files | {"psf_corrected": True}, **changes)
    wanted = (capture[..., ::-1] / 255 - 0.2) / 1.25
    assert dataset.test[0][0].movedim(0, -1).numpy() == pytest.approx(wanted, abs=1e-4)
    assert dataset.test[0][1].movedim(0, -1).numpy() == pytest.approx(capture[..., ::-1] / 255, abs=1e-4)
    other = opened(folder, {"psf_corrected": True}, **changes)
    assert other.identity != dataset.identity


def field_of(folder):
    """Files of a camera that shows the PSF at half the light at its right border."""
    psf = np.load(folder / "psf.npy")
    np.save(folder / "right.npy", np.roll(psf[::-1], 3, 0) / 2)
    return {"field_psfs": [folder / "right.npy"], "field_positions": [(0.0, 31.0)]}


def test_simulated_captures_have_the_field_of_the_camera(folder):
    changes = {"photos": str(folder / "photos"), "test_photos": str(folder / "test"), "train": 1, "test": 1}
    changes |= {"validation": 1, "sensor": Sensor(full_well=1e9, read_noise=0.0)}
    changes |= {"placement": Placement(ambient=(0.0, 0.0))}
    dataset = opened(folder, field_of(folder), **changes)
    measurement, scene = dataset.test[0]
    field = measurement - field_camera(dataset.calibration).forward(scene[None])
    one_psf = measurement - convolve(scene[None], dataset.calibration.psf)
    assert field.norm() < 0.05 * one_psf.norm()
    assert dataset.identity != opened(folder, {}, **changes).identity
    with pytest.raises(ParameterError, match=r"`field_psfs`.*`deviation`"):
        opened(folder, field_of(folder), **changes, deviation=Deviation(shift_px=1.0))
    with pytest.raises(ParameterError, match=r"`noise` for `.*`, not `shift_px`"):
        check_axes(Robustness(sizes={"noise": (2.0,), "shift_px": (1.0,)}), dataset)
    check_axes(Robustness(sizes={"noise": (2.0,)}), dataset)


def grey_camera(folder, **content):
    """camera.toml of a grey camera, and a grey capture."""
    np.save(folder / "grey.npy", np.load(folder / "psf.npy")[..., :1])
    write_camera(folder / "camera.toml", {"psf": folder / "grey.npy", "background": 0.0, "grey": True, **content})
    cv2.imwrite(str(folder / "capture.png"), np.random.default_rng(0).integers(20, 200, (48, 64), np.uint8))
    changed = RECIPE.replace('psf = "psf.npy"', 'camera = "camera.toml", captures = ["capture.png"]')
    changed = changed.replace("quick = {", "universal-small = {}, quick = {")
    for line in ("ablation =", "compared =", "robustness ="):
        changed = re.sub(f"^{line}.*\n", "", changed, flags=re.MULTILINE)
    return changed.replace("steps = 6", "steps = 1").replace("train = 4", "train = 0")


def test_a_grey_camera(folder):
    """Its networks have one channel, and its captures are shown with the pairs' reconstructions."""
    (folder / "r.toml").write_text(grey_camera(folder), encoding="utf-8")
    results = run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu", lpips=False)
    assert PairFile(folder / "out" / "data" / "caustic.h5").measurement_shape == (48, 64, 1)
    assert read_metadata(folder / "out" / "runs" / "caustic" / "mwdn" / "best.safetensors")["options"]["channels"] == 1
    for result in results.methods["caustic"].values():
        assert (len(result.pictures), len(result.captures)) == (2, 1)


def test_captures_are_reconstructed_again_where_a_frame_has_changed(folder, monkeypatch):
    """With another dark frame under the same name, the page showed the captures as corrected by the old one."""
    cv2.imwrite(str(folder / "dark.png"), np.full((48, 64), 10, np.uint8))
    recipe = grey_camera(folder, dark=folder / "dark.png", psf_corrected=True)
    (folder / "r.toml").write_text(re.sub(r"networks = .*|ablation = .*|compared = .*", "", recipe), encoding="utf-8")

    def shown():
        methods = run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu", lpips=False).methods["caustic"]
        return methods["quick"]

    first = shown()
    cv2.imwrite(str(folder / "dark.png"), np.full((48, 64), 19, np.uint8))
    monkeypatch.setattr(scoring, "_measure", None)  # the pairs do not depend on it
    second = shown()
    assert second.scores.values == first.scores.values
    assert (second.captures - first.captures).abs().max() > 0.01 * first.captures.max()
    monkeypatch.setattr(scoring, "make_reconstructor", None)
    assert torch.equal(shown().captures, second.captures)


def test_a_file_of_other_pairs_needs_another_folder(folder):
    """Trainings and scores of the old pairs were reported as those of the new ones."""
    recipe = DatasetRecipe(psf=str(folder / "psf.npy"), background=0.0, pairs=str(folder / "p.h5"), split="random")
    for value in (0.3, 0.3, 0.4):
        with PairFile.create(folder / "p.h5", measurement_shape=(48, 64, 3), scene_shape=(48, 64, 3)) as file:
            file.append(torch.full((10, 3, 48, 64), value), torch.ones(10, 3, 48, 64))
        if value == 0.3:  # a copy of the file is the same
            open_dataset("p", recipe, folder / "out" / "data", torch.device("cpu"), lambda _, rows: rows)
    with pytest.raises(ParameterError, match=r"`.*p\.h5` .*`.*out`"):
        open_dataset("p", recipe, folder / "out" / "data", torch.device("cpu"), lambda _, rows: rows)


@pytest.mark.parametrize(
    ("before", "after", "camera", "said"),
    [
        ("mwdn = {}", "mwdn = { channels = 3 }", {}, r"`channels`.*\(3\).*`caustic`.*`channels = 1`"),
        ("x", "x", {"grey": False}, r"`channels`.*\(3\) must be 1.*captures of `caustic`.*`grey = true`"),
        (
            "[data]",
            '[data]\ncolour = { psf = "psf.npy", train = 4, validation = 2, test = 3, trained_on = "caustic" }',
            {},
            r"`channels`.*\(1\) must be 3.*`colour`.*`caustic`",
        ),
    ],
)
def test_networks_of_other_colours_are_refused_before_training(folder, before, after, camera, said):
    (folder / "r.toml").write_text(grey_camera(folder, **camera).replace(before, after, 1), encoding="utf-8")
    with pytest.raises(ParameterError, match=said):
        run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu", lpips=False)
    assert not (folder / "out" / "runs").exists()


def test_a_loss_with_alexnet_downloads_nothing_unasked(folder, monkeypatch):
    monkeypatch.delenv("MWDN_ALEXNET", raising=False)
    monkeypatch.setattr(alexnet, "cache_folder", lambda: folder / "cache")
    monkeypatch.setattr(alexnet, "urlopen", lambda *_, **__: pytest.fail("nobody asked for a download"))
    text = RECIPE.replace('alexnet = "nowhere.pth"', "loss = { mse = 1.0, feature_mse = 1.0 }")
    (folder / "r.toml").write_text(text, encoding="utf-8")
    with pytest.raises(CheckpointError, match="--lpips"):
        run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu")
    assert not (folder / "out").exists()


def test_widths_shrink_alike(tmp_path):
    text = RECIPE.replace("shared.network = { width = 2 }", "width_factor = 0.25").replace(
        "mwdn = {} }", 'mwdn = {}, own = { name = "mwdn", width = 5 } }'
    )
    (tmp_path / "r.toml").write_text(text, encoding="utf-8")
    options = {method.label: method.options for method in read_benchmark(tmp_path / "r.toml").methods}
    assert options == {"quick": {"iterations": 3}, "wiener": {}, "mwdn": {"width": 16}, "own": {"width": 5}}


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("[shared.netwrok]\nwidth = 2", "netwrok"),
        ('[data.mine]\npreset = "mwdn-smi"', "mwdn-smi"),
    ],
)
def test_mistyped_tables_and_presets_are_named(tmp_path, line, said):
    (tmp_path / "r.toml").write_text(f"networks = {{ wiener = {{}} }}\n{line}\n", encoding="utf-8")
    with pytest.raises(UnknownNameError, match=said):
        read_benchmark(tmp_path / "r.toml")


@pytest.mark.parametrize("name", ["benchmark-small", "benchmark-ablation", "benchmark-quarter", "benchmark-paper"])
def test_recipes_that_come_along(name, monkeypatch):
    monkeypatch.setenv("MWDN_DATA", "/data")
    monkeypatch.setenv("MWDN_PUBLIC", "/public")
    benchmark = read_benchmark(name)
    assert {"wiener", "unet", "wiener-unet", "mwdn", "mwdn-cpsf"} <= {method.label for method in benchmark.methods}
    assert benchmark.data["mwdn-sim"].psf == "/data/mwdn-camera/psf_320.png"
    if name not in ("benchmark-ablation", "benchmark-quarter"):  # one camera
        assert benchmark.data["diffusercam-real"].trained_on == "diffusercam-sim"
    for recipe in benchmark.data.values():
        assert (protocol := recipe.binned_protocol()).name == "full" or protocol.rows or protocol.centre


def test_a_training_does_not_hash_its_pairs(folder, monkeypatch):
    """It read 16 pairs of each data set for a hash that nothing compared."""
    (folder / "r.toml").write_text(RECIPE.replace("steps = 6", "steps = 1"), encoding="utf-8")
    benchmark = read_benchmark(folder / "r.toml")
    recipe = benchmark.data["caustic"]
    dataset = open_dataset("caustic", recipe, folder, torch.device("cpu"), lambda _, rows: rows)
    monkeypatch.setattr(RecordedPairs, "fingerprint", "hash")  # beartype looks at it, so it cannot raise
    train(benchmark.methods[-1], dataset, benchmark, folder / "run", device=torch.device("cpu"), show=lambda _: None)
    with safe_open(folder / "run" / "state.safetensors", "pt") as state:
        assert state.metadata()["samples"] == ""


def only(solvers="{}", networks="{}"):
    """The recipe with these methods alone."""
    text = re.sub("robustness = .*", "", RECIPE).replace('ablation = ["wiener", "mwdn"]\ncompared = "mwdn"', "")
    text = text.replace('{ quick = { name = "admm", iterations = 3 } }', solvers)
    return text.replace("{ wiener = {}, mwdn = {} }", networks)


def test_metrics_that_were_not_requested_are_measured_when_they_are(folder, monkeypatch):
    """Scores without LPIPS were kept for ever, and a method added later had a column of its own."""
    (folder / "r.toml").write_text(only('{ quick = { name = "admm", iterations = 3 } }'), encoding="utf-8")
    calls = []
    measure = scoring.evaluate
    monkeypatch.setattr(scoring, "evaluate", lambda *args, **options: calls.append(1) or measure(*args, **options))
    monkeypatch.setattr(Perceptual, "load", lambda *_, **__: Perceptual(None, None, {}))
    seen = []
    for lpips in (False, None, False):
        run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu", lpips=lpips)
        missing = json.loads((folder / "out" / "benchmark.json").read_text())["sets"]["caustic"]["missing"]
        seen.append((sorted(missing), len(calls)))
    assert seen == [(["feature_mse", "lpips"], 1), ([], 2), ([], 2)]
    monkeypatch.setattr(Perceptual, "load", lambda *_, **__: pytest.fail("all metrics are saved"))
    run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu")
    (folder / "r.toml").write_text(only("{ pyramid = {}, admm = { iterations = 1 } }"), encoding="utf-8")
    run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu", lpips=False)
    assert "lpips is missing: not requested" in (folder / "out" / "benchmark.md").read_text()


def test_another_split_of_recorded_pairs_needs_another_folder(folder):
    """Networks were tested on pairs that they were trained on, and `mwdn evaluate` was told the wrong split."""
    with PairFile.create(folder / "p.h5", measurement_shape=(48, 64, 3), scene_shape=(48, 64, 3)) as file:
        file.append(torch.rand(10, 3, 48, 64), torch.rand(10, 3, 48, 64))
    text = only(networks="{ wiener = {} }").partition("[data]")[0].replace("steps = 6", "steps = 1")
    for split in ("paper", "random"):
        data = f'[data]\nreal = {{ psf = "psf.npy", pairs = "p.h5", split = "{split}", seed = 5 }}\n'
        (folder / f"{split}.toml").write_text(text + data, encoding="utf-8")
    run(read_benchmark(folder / "random.toml"), folder / "out", device="cpu", lpips=False)
    known = read_metadata(folder / "out" / "runs" / "real" / "wiener" / "best.safetensors")["recipe"]["pairs"]
    assert (known["split"], known["seed"]) == ("random", 5)
    with pytest.raises(CheckpointError, match="another recipe"):
        run(read_benchmark(folder / "paper.toml"), folder / "out", device="cpu", lpips=False)


@pytest.mark.parametrize(("aligns", "count"), [("true", 4), ("false", 0)])
def test_a_network_with_an_aligned_psf_learns_from_aligned_pairs(folder, monkeypatch, aligns, count):
    """As it is tested. Each of the two pairs for training and the two for validation is aligned once."""
    aligned = []
    monkeypatch.setattr(recorded, "align", lambda one, psf: aligned.append(one) or align(one, psf))
    network = f'"wiener-bank", finest = 4, align = {aligns}, schedule = {{ pool = 2 }}'
    (folder / "r.toml").write_text(only(networks=f"{{ net = {{ name = {network} }} }}"), encoding="utf-8")
    benchmark = read_benchmark(folder / "r.toml")
    dataset = open_dataset("caustic", benchmark.data["caustic"], folder, torch.device("cpu"), lambda _, rows: rows)
    train(benchmark.methods[0], dataset, benchmark, folder / "run", device=torch.device("cpu"), show=lambda _: None)
    assert len(aligned) == count


def test_pairs_of_a_camera_that_is_upside_down_and_bgr(folder):
    """Its PSF was turned upright, its captures and scenes were not."""
    picture = np.random.default_rng(1).integers(0, 200, (48, 64, 3), np.uint8)
    ten_pairs(folder, picture)
    recipe = DatasetRecipe(psf=str(folder / "psf.npy"), kind="folders", pairs=str(folder / "pairs"), split="random")
    for turned in (False, True):
        changed = replace(recipe, upside_down=turned, bgr=turned)
        test = open_dataset(f"turned-{turned}", changed, folder, torch.device("cpu"), lambda _, rows: rows).test
        wanted = picture[::-1] if turned else picture[..., ::-1]
        for part in test[0]:
            assert (255 * part.movedim(0, -1).numpy()).round().astype(int).tolist() == wanted.tolist()


def test_a_camera_that_is_drawn_for_each_pair_has_no_robustness_but_to_noise(folder):
    """Shift and turn changed nothing, so that every method looked perfectly robust."""
    text = RECIPE.replace("deviation = { turn_degrees = 1, off_axis = 1 }", "mismatch = { blur_px = 0.5 }")
    (folder / "r.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ParameterError, match=r"`noise` for `caustic`, not `shift_px`: its `mismatch`"):
        run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu", lpips=False)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("count = 0, noise = [2]", r"`count` \(0\) of \[robustness\] must be at least 1"),
        ("count = 2, noise = [0]", r"`noise` \(0\) of \[robustness\] must be positive"),
        ("count = 2, off_axis = [3]", r"`off_axis` \(4.0\) must be from 0 to 3.3"),
    ],
)
def test_sizes_of_robustness_are_checked_before_the_training(folder, line, message):
    text = RECIPE.replace("count = 2, noise = [2], shift_px = [1]", line)
    (folder / "r.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ParameterError, match=message):
        run(read_benchmark(folder / "r.toml"), folder / "out", device="cpu", lpips=False)


def test_two_lines_that_are_one_training_are_refused(folder):
    """`--seed 1` made `mwdn` the same as a line with the seed 1."""
    (folder / "r.toml").write_text(
        only(networks='{ wiener = {}, second = { name = "wiener", schedule = { seed = 1 } } }'), encoding="utf-8"
    )
    benchmark = read_benchmark(folder / "r.toml")
    benchmark = replace(benchmark, schedule=replace(benchmark.schedule, seed=1))
    with pytest.raises(ParameterError, match=r"`wiener` and `second` are the same network with the same seed \(1\)"):
        run(benchmark, folder / "out", device="cpu", lpips=False)


def test_the_time_before_an_interruption_counts(folder):
    """Its steps are kept: the times of interrupted trainings were too short."""
    (folder / "r.toml").write_text(RECIPE.replace("validate_every = 2", "validate_every = 6"), encoding="utf-8")
    benchmark = read_benchmark(folder / "r.toml")
    dataset = open_dataset("caustic", benchmark.data["caustic"], folder, torch.device("cpu"), lambda _, rows: rows)

    def go(show):
        method = benchmark.methods[1]
        train(method, dataset, benchmark, folder / "run", device=torch.device("cpu"), show=show)

    def slow(report):
        if report.step == 3:
            time.sleep(1)
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="after step 3"):
        go(slow)
    assert seconds(folder / "run") >= 1
    go(lambda _: None)
    assert seconds(folder / "run") >= 1
    assert json.loads((folder / "run" / "clock.json").read_text())["step"] == 6


def test_samples_are_a_stage_before_the_steps():
    """A recipe with `pool` showed a training at 0 % for as long as its samples took."""
    seen = []
    watch = Watch(lambda title, parts: seen.append((title, parts)), lambda done, note: seen.append(done))
    samples = watch.training("data", "net", Schedule(steps=10, pool=4))
    for done in (1, 2):  # the first one from an interrupted run
        samples(done, 2)
    assert seen == [("data: simulating samples for net", 2), 1, 2, ("data: training net", 10)]
    seen.clear()
    watch.training("data", "net", Schedule(steps=10))
    assert seen == [("data: training net", 10)]
