"""The commands `mwdn train` and `mwdn simulate`, and their files."""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import read_frame
from mwdn.bridges import save_pretrained
from mwdn.calibration import Calibration
from mwdn.data.pairs import PairFile
from mwdn.data.recorded import Division
from mwdn.fourier.convolution import convolve
from mwdn.inference.reconstructor import Reconstructor
from mwdn.networks import build
from mwdn.weights.checkpoint import save_network

RECIPE = """
network = { name = "wiener" }
schedule = { steps = 9, batch = 2, validate_every = 2, validation = 2, bfloat16 = false }
placement = { extent = [0.4, 0.4] }
"""


@pytest.fixture
def camera(tmp_path, monkeypatch, generator):
    """Current folder with psf.npy, other.npy, photos, a capture and r.toml."""
    monkeypatch.chdir(tmp_path)
    for name in ("psf", "other"):
        psf = contour_psf((32, 40), cell=10, generator=generator).expand(1, 3, -1, -1)
        np.save(f"{name}.npy", (0.9 * psf / psf.max())[0].movedim(0, -1).numpy())
    np.save("capture.npy", np.full((32, 40, 3), 0.3, np.float32))
    (tmp_path / "photos").mkdir()
    for number in range(3):
        small = np.random.default_rng(number).integers(0, 256, (4, 4, 3), np.uint8)
        cv2.imwrite(f"photos/{number}.png", cv2.resize(small, (24, 24), interpolation=cv2.INTER_CUBIC))
    (tmp_path / "r.toml").write_text(RECIPE, encoding="utf-8")
    return tmp_path


def flat(text):
    return re.sub(r"[\s│]+", " ", text)


TRAIN = "train r.toml --psf psf.npy --photos photos --steps 4 --device cpu --out runs/x"
BANK = "--network.name wiener-bank --network.width 2 --network.finest 0 --network.align=false"
RECONSTRUCT = "reconstruct capture.npy --method runs/x/best.safetensors --device cpu --psf"


def test_train_then_reconstruct(run, camera):
    line = f"{TRAIN} {BANK}"
    code, out, err = run(line)
    assert code == 0, err
    assert "Weights in runs/x/best.safetensors" in out
    assert re.search(r"step 4: validation \d+\.\d\d dB, best \d+\.\d\d dB", flat(err))
    code, out, err = run(f"{RECONSTRUCT} psf.npy")
    assert code == 0
    assert "capture.npy: the picture reproduces" in out + err
    assert read_frame("results/reconstruct/capture.png").shape == (32, 40, 3)
    assert run(line)[0] == 0  # nothing left to do


def test_a_run_that_ends_within_its_warmup_says_so(run, camera):
    sentence = "The warm-up (50 steps) is not over when the run ends (4)"
    assert sentence in flat(run(TRAIN)[2])
    assert "warm-up" not in flat(run(f"{TRAIN.replace('runs/x', 'runs/y')} --schedule.warmup 2")[2])


def test_any_key_of_the_recipe_by_its_name(run, camera):
    changes = "--learning-rate 3e-4 --bfloat16=false --seed -2 --mismatch.blur-px 1 --placement.extent [0.3,0.5]"
    code, _, err = run(f"{TRAIN} {BANK} {changes} --schedule.crop 16 --pool 8")
    assert code == 0, err
    recipe = json.loads((camera / "runs/x/recipe.json").read_text(encoding="utf-8"))["recipe"]
    schedule = recipe["schedule"]
    assert [schedule[key] for key in ("learning_rate", "seed", "crop", "pool")] == [3e-4, -2, 16, 8]
    assert (recipe["mismatch"]["blur_px"], recipe["placement"]["extent"]) == (1.0, [0.3, 0.5])
    assert recipe["network"] == {"name": "wiener-bank", "width": 2, "finest": 0, "align": False}
    for wrong, said in (
        ("--learnin-rate 1", "No key of [schedule] named 'learnin_rate'. Did you mean 'learning_rate'?"),
        ("--sensor.iso 100", "No key of [sensor] named 'iso'"),
        ("--steps many", "`steps` of [schedule] ('many') must be a whole number; the default is 2000."),
        ("--seed", "`--seed` must be followed by"),
    ):
        code, _, err = run(f"train r.toml --psf psf.npy --photos photos --out runs/y {wrong}")
        assert code == 2
        assert said in flat(err)
    assert not (camera / "runs/y").exists()


def test_simulate_by_the_recipes_keys(run, camera):
    for name, well in (("good", 15_000), ("poor", 50)):
        line = f"simulate photos --psf psf.npy --count 2 --exact --seed 3 --sensor.full-well {well} -o {name}.h5"
        code, _, err = run(line)
        assert code == 0, err
    good, poor = (PairFile(camera / f"{name}.h5")[0] for name in ("good", "poor"))
    assert torch.equal(good[1], poor[1])
    assert (good[0] - poor[0]).std() > 0.05 * good[0].max()


def test_checkpoint_of_another_camera_is_used_with_a_warning(run, camera):
    assert run(TRAIN)[0] == 0
    trained, given = (Calibration.from_file(f"{name}.npy").psf_hash for name in ("psf", "other"))
    code, _, err = run(f"{RECONSTRUCT} other.npy")
    assert code == 0
    assert err.count(f"Warning: `runs/x/best.safetensors` was trained for PSF {trained}") == 1
    assert given in err
    assert "Expect blur, ghosts and invented detail" in err
    assert read_frame("results/reconstruct/capture.png").shape == (32, 40, 3)


def test_warning_of_a_reconstructor(camera):
    calibration = Calibration.from_file("psf.npy")
    network = build("wiener-bank", width=2)
    for name, told in (("any", {}), ("own", {"psf_hash": calibration.psf_hash}), ("other", {"psf_hash": "0" * 16})):
        save_network(f"{name}.safetensors", network, "wiener-bank", {"width": 2}, **told)
        warning = Reconstructor(f"{name}.safetensors", calibration, device="cpu").warning
        assert (warning is not None) == (name == "other")
    assert Reconstructor("wiener", calibration).warning is None
    assert Reconstructor(network, calibration).warning is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (TRAIN.replace("runs/x", "r.toml"), "`r.toml` must be a folder that can be written to"),
        (TRAIN.replace("--photos photos", "--photos runs"), "`runs` is not a folder"),
        (TRAIN.replace("runs/x", "photos/x"), "`photos/x` lies in the folder of photographs `photos`"),
        (TRAIN.replace("--photos photos", ""), "`--photos`, or recorded pairs, `--pairs`"),
        (
            TRAIN + " --pairs p.h5",
            "Photographs (`photos`) and pairs (`p.h5`) exclude each other.",
        ),
        (TRAIN.replace("--photos photos", "--pairs p.h5"), "`p.h5` does not exist"),
        (TRAIN + " --captures runs", "`runs`"),
        (TRAIN.replace("train r.toml", "train r.tml"), "`r.tml` does not exist"),
        (TRAIN.replace("--steps 4", "--steps 0"), "[schedule]: `--steps` (0) must be positive"),
        (TRAIN.replace("--device cpu", "--device gpu"), "`--device` (gpu) must be one that torch can use here"),
        (TRAIN.replace("--device cpu", "--device cuda:99"), "`--device` (cuda:99) must be one that torch can use here"),
        ("simulate photos --psf psf.npy --exact --mismatch.haze 0.1", "leave out `--exact`"),
        ("simulate photos --psf psf.npy --count 0", "`--count` (0) must be at least 1"),
        ("simulate photos --psf psf.npy -o photos", "`photos` cannot be written: Is a directory"),
        ("simulate photos --psf psf.npy -o photos/0.png", "`0.png` must end in .h5 or .hdf5"),
        ("simulate photos --psf psf.npy -o psf.npy", "`psf.npy` would overwrite an input"),
        (f"simulate photos --psf psf.npy --seed {10**23}", f"`--seed` ({10**23}) must have 63 bits at most"),
        ("simulate nothing --psf psf.npy", "`nothing` is not a folder. Name a folder of photographs."),
    ],
)
def test_wrong_call_is_one_message_and_exit_2(run, camera, line, said):
    before = {path: path.read_bytes() for path in camera.rglob("*") if path.is_file()}
    code, _, err = run(line)
    assert code == 2
    assert said in flat(err)
    assert "Traceback" not in err
    assert not list(camera.glob("*.h5"))
    assert all(path.read_bytes() == content for path, content in before.items())


def test_train_on_recorded_pairs(run, camera):
    assert run("simulate photos --psf psf.npy -o pairs.h5 --count 20 --recipe r.toml")[0] == 0
    line = TRAIN.replace("--photos photos", "--pairs pairs.h5")
    code, out, err = run(line)
    assert code == 0, err
    assert "Weights in runs/x/best.safetensors" in out
    assert run(f"{RECONSTRUCT} psf.npy")[0] == 0
    np.save("large.npy", np.kron(np.load("psf.npy"), np.ones((2, 2, 1), np.float32)))
    code, _, err = run(line.replace("psf.npy", "large.npy"))
    assert code == 2
    assert "The PSF is 2 times as large" in flat(err)
    assert run(line.replace("psf.npy", "large.npy --psf-bin 2").replace("runs/x", "runs/y"))[0] == 0


def test_grey_camera_learns_from_photographs(run, camera):
    """Scenes are averaged over their colours for a network of one channel. `simulate --grey` does the same."""
    np.save("grey.npy", np.load("psf.npy").mean(2, keepdims=True))
    np.save("capture.npy", np.full((32, 40, 1), 0.3, np.float32))
    line = TRAIN.replace("psf.npy", "grey.npy") + " --network.name unet --network.width 2 --network.channels 1"
    code, _, err = run(line)
    assert code == 0, err
    assert run(f"{RECONSTRUCT} grey.npy --no-trust")[0] == 0
    for colours in ("3", "1"):
        code, _, err = run(f"{line} --grey".replace("channels 1", f"channels {colours}").replace("runs/x", colours))
        assert (code, "`--network.channels 1`" in flat(err)) == ((2, True) if colours == "3" else (0, False))
    assert not Path("3").exists()
    assert run("simulate photos --psf grey.npy --grey -o pairs.h5 --count 2 --recipe r.toml")[0] == 0
    assert PairFile("pairs.h5").scene_shape == PairFile("pairs.h5").measurement_shape == (32, 40, 1)


def test_only_a_grey_psf_leaves_open_whether_captures_are_grey(run, camera):
    np.save("grey.npy", np.load("psf.npy").mean(2, keepdims=True))
    train = TRAIN + " --network.name unet --network.width 2"
    for line, options in (
        ("simulate photos --psf psf.npy -o pairs.h5 --count 1", "`--grey`"),
        (train, "`--grey --network.channels 1`"),
    ):
        for psf, is_open in (("psf.npy", False), ("grey.npy", True)):
            code, _, err = run(line.replace("psf.npy", psf).replace("runs/x", psf[:3]))
            assert (code, f"If those of the camera are grey: {options}" in flat(err)) == (0, is_open), err
    assert "If those of the camera" not in run("simulate photos --psf grey.npy --grey -o pairs.h5 --count 1")[2]
    assert "If those of the camera" not in run(TRAIN.replace("psf.npy", "grey.npy"))[2]  # takes both


def test_pairs_of_another_camera_and_a_finished_run_are_named(run, camera):
    assert run("simulate photos --psf psf.npy -o pairs.h5 --count 20 --recipe r.toml")[0] == 0
    line = TRAIN.replace("--photos photos", "--pairs pairs.h5").replace("psf.npy", "other.npy")
    code, _, err = run(line)
    assert (code, "holds pairs of the camera of PSF" in flat(err)) == (0, True)
    code, _, err = run(line)
    assert (code, "was finished before" in flat(err)) == (0, True)
    assert "`schedule.steps` is 4 there, 5 here" in flat(run(line.replace("--steps 4", "--steps 5"))[2])


def test_a_run_does_not_go_on_with_other_data(run, camera):
    """Nor is a finished one taken for one on the data given now, unless they are a copy of its own."""
    for seed in (0, 1):
        assert run(f"simulate photos --psf psf.npy -o pairs{seed}.h5 --count 20 --recipe r.toml --seed {seed}")[0] == 0
    shutil.copytree("photos", "more")
    shutil.copy("more/0.png", "more/copy.png")
    first, data = "--photos photos", (("--pairs pairs0.h5", "--pairs pairs1.h5"), ("--photos photos", "--photos more"))
    for name, (given, other) in zip("ab", data, strict=True):
        line = TRAIN.replace(first, given).replace("runs/x", name)
        assert run(line)[0] == 0
        before = {path.name: path.read_bytes() for path in Path(name).iterdir()}
        code, _, err = run(line.replace(given, other))
        assert (code, other.split()[1] in flat(err), f"`{name}` holds a run" in flat(err)) == (2, True, True)
        assert before == {path.name: path.read_bytes() for path in Path(name).iterdir()}
    shutil.copy("pairs0.h5", "copy.h5")
    os.utime("copy.h5", (0, 0))
    assert run(TRAIN.replace(first, "--pairs copy.h5").replace("runs/x", "a"))[0] == 0


def test_the_file_of_pairs_and_the_table_have_one_name(run, camera):
    """`--pairs` is a file and `--pairs.split` a key of the recipe, in either order."""
    assert run("simulate photos --psf psf.npy -o pairs.h5 --count 20 --recipe r.toml")[0] == 0
    line = TRAIN.replace("--photos photos --steps 4", "--pairs pairs.h5 --pairs.split random --best-by loss --steps 1")
    code, _, err = run(line)
    assert code == 0, err
    assert re.search(r"validation \d+\.\d\d dB, best loss \d", flat(err))
    assert json.loads((camera / "runs/x/recipe.json").read_text())["recipe"]["pairs"]["split"] == "random"
    code, _, err = run(line.replace("--pairs pairs.h5 --pairs.split random", "--pairs.splt random --pairs pairs.h5"))
    assert (code, "No key of [pairs] named 'splt'" in err) == (2, True)
    code, out, err = run("evaluate wiener --data pairs.h5 --psf psf.npy --device cpu --split paper --no-lpips --json")
    assert code == 0, err
    assert json.loads(out)["pictures"] == 2  # the test's tenth of twenty
    code, _, err = run("evaluate wiener --data pairs.h5 --psf psf.npy --split folds")
    assert (code, "has no test part" in err) == (2, True)
    code, out, err = run("evaluate wiener --data pairs.h5 --psf psf.npy --part test")  # of which split?
    assert (code, out, "--split" in err) == (2, "", True)


def test_a_checkpoint_is_evaluated_on_the_pairs_that_its_training_left_out(run, camera):
    assert run("simulate photos --psf psf.npy -o pairs.h5 --count 20 --recipe r.toml")[0] == 0
    line = TRAIN.replace("--photos photos --steps 4", "--pairs pairs.h5 --pairs.split folds --steps 1")
    assert run(f"{line} --pairs.fold 1")[0] == 0
    evaluate = "evaluate runs/x/best.safetensors --data pairs.h5 --psf psf.npy --device cpu --no-lpips --json"

    scores, said = [], []
    for options in ("", " --first 4", " --split folds --part validation", " --split paper"):
        code, out, err = run(evaluate + options)
        assert code == 0, err
        scores += [json.loads(out)["methods"]["runs/x/best.safetensors"]["values"]["psnr"]]
        said += [re.findall(r"was trained on (\d+) of these (\d+)", flat(err))]
    assert said == [[("15", "20")], [("4", "4")], [], [("2", "2")]]
    held_out = Division("folds", fold=1).parts(20)["validation"]
    assert scores[2] == pytest.approx([scores[0][n] for n in held_out], abs=1e-3)
    save_pretrained("runs/x/best.safetensors", "hub")
    assert "was trained on 15 of these 20" in flat(run(evaluate.replace("runs/x/best.safetensors", "hub"))[2])
    assert run(line.replace("runs/x", "runs/y"))[0] == 0
    code, _, err = run(
        evaluate.replace("best.safetensors ", "best.safetensors runs/y/best.safetensors ") + " --split folds"
    )
    assert (code, "in different ways" in err) == (2, True)


@pytest.mark.acceptance
def test_tensorboard_and_captures(run, camera):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    np.save("second.npy", np.full((32, 40, 3), 0.1, np.float32))
    (camera / "r.toml").write_text(RECIPE + 'sheet = { captures = ["none.npy"] }', encoding="utf-8")  # not looked for
    code, _, err = run(f"{TRAIN} --tensorboard --captures capture.npy second.npy")
    assert code == 0, err
    events = EventAccumulator("runs/x/tensorboard").Reload()
    lines = [json.loads(line) for line in (camera / "runs" / "x" / "log.jsonl").read_text().splitlines()]
    for tag, key in (("loss/total", "loss"), ("loss/mse", "mse"), ("learning_rate", "learning_rate")):
        assert [e.value for e in events.Scalars(tag)] == pytest.approx([line[key] for line in lines])
    assert [e.step for e in events.Scalars("pictures_per_s")] == [1, 2, 3, 4]
    for tag, key in (("validation/psnr", "psnr"), ("validation/loss", "validation_loss")):
        measured = {line["step"]: pytest.approx(line[key]) for line in lines if line[key] is not None}
        assert {e.step: e.value for e in events.Scalars(tag)} == measured
        assert measured.keys() == {2, 4}
    image = events.Images("validation")[-1]
    sheet = read_frame("runs/x/validation.png")
    assert (image.step, image.height, image.width) == (4, *sheet.shape[:2])
    assert sheet.shape[1] == 5 * (300 + 6)  # measurement, reconstruction, scene; capture, reconstruction


def test_captures_of_the_recipe_exclude_the_psf(run, camera):
    (camera / "frames").mkdir()
    for name in ("psf.npy", "capture.npy"):
        (camera / name).rename(camera / "frames" / name)
    (camera / "r.toml").write_text(RECIPE + 'sheet = { captures = ["frames"] }', encoding="utf-8")
    (camera / "photos" / "phone.heic").touch()
    code, _, err = run(TRAIN.replace("psf.npy", "frames/psf.npy"))
    assert code == 0, err
    assert "psf.npy (the PSF)" in err
    assert "phone.heic (formats that are not read" in flat(err)
    sheet = read_frame("runs/x/validation.png")
    assert (sheet[26 + 240 + 6 :, 3 * 306 :] == 255).all()  # one capture, two pairs
    assert not (sheet[26 : 26 + 240, 3 * 306 :] == 255).all()


def test_tensorboard_that_is_not_installed(run, camera, monkeypatch):
    for name in ["tensorboard", *(name for name in sys.modules if name.startswith("torch.utils.tensorboard"))]:
        monkeypatch.setitem(sys.modules, name, None)
    code, _, err = run(f"{TRAIN} --tensorboard")
    assert code == 2
    assert "`--tensorboard` needs the package tensorboard" in flat(err)
    assert "`pip install 'mwdn[tensorboard]'`" in flat(err)
    assert not (camera / "runs" / "x" / "log.jsonl").read_text()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of a file")
def test_full_disk_is_one_message_and_leaves_the_last_state(run, camera):
    """A limit on the size of files, below that of a state, stands for a full disk."""
    import resource

    line = f"{TRAIN.replace('--steps 4', '--steps 2')} {BANK.replace('width 2', 'width 4')}"  # largest: the state
    assert run(line)[0] == 0
    files = sorted(path.name for path in (camera / "runs/x").iterdir())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((camera / "runs/x/state.safetensors").stat().st_size - 1, limits[1]))
    try:
        code, _, err = run(line.replace("runs/x", "runs/y"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 2
    assert "Traceback" not in err
    assert re.search(r"`runs/y` must be a folder that can be written to: .*File too large.* Make room and", flat(err))
    files.remove("state.safetensors")
    assert sorted(path.name for path in (camera / "runs/y").iterdir()) == files
    assert run(line.replace("runs/x", "runs/y"))[0] == 0  # with room


def test_simulate_then_evaluate(run, camera):
    code, out, err = run("simulate photos --psf psf.npy -o pairs.h5 --count 5 --recipe r.toml --seed 3")
    assert code == 0, err
    assert "5 pairs written to pairs.h5" in out
    calibration = Calibration.from_file("psf.npy")
    with PairFile("pairs.h5") as file:
        assert len(file) == 5
        assert file.attributes == {"psf_hash": calibration.psf_hash, "seed": 3, "refined": "simulate"}
        assert torch.equal(file.psf, calibration.psf)
        measurement, scene = file[4]
        assert measurement.shape == scene.shape == (3, 32, 40)
        assert measurement.dtype == torch.float32
        assert 0 < scene.count_nonzero() < 1.6 * 3 * (0.4 * 32 + 4) ** 2  # the recipe's extent
    code, out, err = run("evaluate wiener --data pairs.h5 --psf psf.npy --device cpu")
    assert code == 0, err
    assert "wiener" in out


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--pairs pairs.h5 --mismatch.blur-px 3", "`--mismatch.blur-px` is for simulated captures"),
        ("--pairs pairs.h5 --placement.extent [0.1,0.2]", "`--placement.extent` is for simulated captures"),
        ("--photos photos --pairs.fold 77", "`--pairs.fold` is for recorded pairs"),
        ("--photos photos --captures photos -o photos/run", "lies in the folder of captures `photos`"),
        ("--photos photos --schedule.start universal --network.name mwdn", "`WienerBank`, .* is a `Mwdn`"),
    ],
)
def test_options_without_effect_and_wrong_places_are_refused(run, camera, line, said):
    code, _, err = run(f"train quick-cpu --psf psf.npy --device cpu {line}")
    assert code == 2
    assert re.search(said, flat(err)), err
    assert not (camera / "photos" / "run").exists()


@pytest.mark.parametrize("option", ["--ambient psf.npy", "--gamma srgb"])
def test_options_of_raw_captures_are_not_for_pairs(run, camera, option):
    """They changed nothing, without a word."""
    assert run("simulate photos --psf psf.npy -o pairs.h5 --count 1 --recipe r.toml")[0] == 0
    code, _, err = run(f"evaluate wiener --data pairs.h5 --psf psf.npy --device cpu {option}")
    assert (code, f"leave out `{option.split()[0]}`" in flat(err)) == (2, True)


def test_simulate_is_reproducible_and_exact(run, camera):
    for name, options in (("a", "--seed 1"), ("b", "--seed 1"), ("c", ""), ("exact", "--seed 1 --exact")):
        assert run(f"simulate photos --psf psf.npy -o {name}.h5 --count 3 {options}")[0] == 0
    a, b, c, exact = (PairFile(f"{name}.h5") for name in ("a", "b", "c", "exact"))
    for one, other, another in zip(a, b, c, strict=True):
        assert all(map(torch.equal, one, other))
        assert not torch.equal(one[1], another[1])
    # Apart from ambient light, which is even, only noise distinguishes it from the calibrated camera.
    errors = []
    for file in (exact, a):
        measurement, scene = (torch.stack(part) for part in zip(*(file[i] for i in range(3)), strict=True))
        difference = measurement - convolve(scene, file.psf)
        difference = difference - difference.mean((1, 2, 3), keepdim=True)
        errors.append(float(difference.std() / measurement.std()))
    assert errors[0] < 0.05 < errors[1]
