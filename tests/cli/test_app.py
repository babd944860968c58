"""The commands as a user types them: exit codes, messages, files."""

import importlib.metadata
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import mwdn
from cameras import contour_psf
from full_disk import full_after
from mwdn import Camera, read_frame
from mwdn.cli.app import COMMANDS
from mwdn.cli.demo import DEMO_METHODS, PICTURES
from mwdn.io.toml import find_recipe, packaged_recipes

SIZE = 32, 40


@pytest.fixture
def camera(tmp_path, monkeypatch, generator):
    """Current folder with psf.png, captures a.png, b.png, c.png in `captures`, all 16-bit colour."""
    monkeypatch.chdir(tmp_path)
    psf = contour_psf(SIZE, cell=10, generator=generator)
    (tmp_path / "captures").mkdir()
    store("psf.png", 0.9 * psf / psf.max())
    for i, name in enumerate("abc"):
        scene = torch.zeros(1, 3, *SIZE)
        scene[:, i, 10:20, 12:22] = 0.9
        store(f"captures/{name}.png", Camera(psf).simulate(scene, generator=generator))
    return tmp_path


def store(path, image):
    frame = (image.expand(-1, 3, -1, -1)[0].movedim(0, -1).clamp(0, 1) * 65535).numpy().astype(np.uint16)
    assert cv2.imwrite(str(path), frame[..., ::-1])


def reconstruct(run, *captures, psf="psf.png", out="out", method="wiener", trust=False):
    """The command; the check of the pictures takes longer than the rest together."""
    check = () if trust else ("--no-trust",)
    return run("reconstruct", *captures, "--psf", psf, "--out", out, "--method", method, *check)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# --- reconstruct --------------------------------------------------------------------------------------


def test_one_file(run, camera):
    code, out, err = reconstruct(run, "captures/a.png", method="admm", trust=True)
    assert (code, err) == (0, "")
    assert re.search(r"PSF [0-9a-f]{16}, background 0\.\d{4}, 0\.\d{4}, 0\.\d{4} of the full scale", out)
    assert "\n1 capture reconstructed into out\n" in out
    assert names(camera / "out") == ["a.json", "a.png", "summary.png"]
    assert "a.png: the picture reproduces" in out
    trust = json.loads((camera / "out" / "a.json").read_text())
    assert trust["explained"] > 0.8 * trust["possible"]
    assert not trust["doubtful"]
    picture = read_frame("out/a.png")
    assert picture.shape == (*SIZE, 3)
    inside, outside = picture[12:18, 14:20].mean((0, 1)), picture[24:, 28:].mean((0, 1))
    assert inside[0] > 180
    assert max(inside[1], inside[2], *outside) < 60


def test_many_files_and_a_folder(run, camera):
    code, out, _ = reconstruct(run, "captures/c.png", "captures/a.png", out="some")
    assert (code, names(camera / "some")) == (0, ["a.json", "a.png", "c.json", "c.png", "summary.png"])
    assert "\n2 captures reconstructed into some\n" in out
    code, _, _ = reconstruct(run, "captures", out="all")
    assert (code, names(camera / "all")) == (
        0,
        [*(f"{name}.{kind}" for name in "abc" for kind in ("json", "png")), "summary.png"],
    )
    for name in ("a.png", "c.png"):
        assert (camera / "some" / name).read_bytes() == (camera / "all" / name).read_bytes()


def test_a_pattern_that_matches_the_psf_too(run, camera):
    (camera / "notes.txt").touch()
    code, _, err = reconstruct(run, *sorted(camera.glob("*.png")), camera / "captures")
    assert code == 0
    assert "psf.png (the PSF)" in err
    assert names(camera / "out") == ["a.json", "a.png", "b.json", "b.png", "c.json", "c.png", "summary.png"]
    code, _, err = reconstruct(run, "psf.png")
    assert code == 2
    assert "psf.png (the PSF)" in err


@pytest.mark.parametrize("turned", ["psf", "captures/b"])
def test_an_exif_turn_is_named_once_and_doubts_no_psf_that_fits(run, camera, turned):
    exif = Image.Exif()
    exif[274] = 6
    picture = Image.fromarray((read_frame(camera / f"{turned}.png") >> 8).astype(np.uint8))
    picture.save(camera / f"{turned}.png", exif=exif)
    code, _, err = reconstruct(run, "captures/a.png", "captures/b.png", trust=True)
    assert code == 0
    assert err.count(f"by EXIF orientation: {turned.removeprefix('captures/')}.png.") == 1
    assert err.count("EXIF") == 1


def test_formats_and_checkpoint(run, camera):
    options = {"width": 2}
    mwdn.weights.checkpoint.save_network("net.safetensors", mwdn.build("mwdn", **options), "mwdn", options)
    line = ("reconstruct", "captures/a.png", "--psf", "psf.png", "--out", "out", "--method", "net.safetensors")
    assert run(*line, "--format", "npy", "--device", "cpu", "--no-trust")[0] == 0
    assert read_frame("out/a.npy").dtype == np.float32
    assert names(camera / "out") == ["a.json", "a.npy", "summary.png"]


def test_options_of_the_camera(run, camera):
    line = "reconstruct captures/a.png --psf psf.png --method wiener --background 0.01 --no-trust"
    code, out, err = run(f"{line} --crop 30 32 --bin 2 --bgr --upside-down --dark captures/c.png")
    assert (code, err) == (0, "")
    assert "background 0.0100" in out
    assert read_frame("results/reconstruct/a.png").shape == (15, 16, 3)


def test_one_bad_file_among_many(run, camera):
    (camera / "captures" / "b[red].png").write_bytes((camera / "captures" / "b.png").read_bytes()[:500])
    code, out, err = reconstruct(run, "captures", "captures/none.png")
    assert code == 1
    assert "3 of 5 captures reconstructed into out" in out
    assert [name for name in names(camera / "out") if name.endswith("png")] == [
        "a.png",
        "b.png",
        "c.png",
        "summary.png",
    ]
    first, second = err.splitlines()  # each message on one line, brackets and all
    assert first.startswith("Error: `captures/b[red].png` is cut off")
    assert second.startswith("Error: `captures/none.png` does not exist")
    cv2.imwrite("captures/d.png", np.zeros((*SIZE, 3), np.uint8))
    assert reconstruct(run, "captures/d.png")[2].startswith("captures/d.png: The sensor saw no light")


def test_only_bad_files(run, camera):
    code, out, _ = reconstruct(run, "captures/none.png")
    assert code == 1
    assert "0 of 1" in out
    assert not (camera / "out").exists()


def test_psf_of_another_size(run, camera):
    store("large.png", torch.from_numpy(read_frame("psf.png") / 65535).movedim(-1, 0)[None].repeat(1, 1, 2, 2))
    code, _, err = reconstruct(run, "captures/a.png", psf="large.png")
    assert code == 1
    assert "`--psf` (64 x 80) and the capture (32 x 40) must have the same height and width" in err
    assert "The PSF is 2 times as large: bin it by 2, `--psf-bin 2`." in err
    line = ("reconstruct", "captures/a.png", "--method", "wiener", "--no-trust")
    assert run(*line, "--psf", "large.png", "--psf-bin", "2")[0] == 0
    assert run(*line, "--psf", "psf.png", "--psf-bin", "2")[0] == 1
    (camera / "halves").mkdir()
    store("halves/a.png", torch.rand(1, 3, 2 * SIZE[0], 2 * SIZE[1]))
    line = ("reconstruct", "halves", "--method", "wiener", "--psf", "psf.png", "--no-trust")
    assert "`--bin 2 --psf-bin 1`" in run(*line)[2]
    assert run(*line, "--bin", "2", "--psf-bin", "1")[0] == 0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("captures --psf none.png", "`none.png` does not exist"),
        ("captures --psf psf.png --method admn", "No method named 'admn'. Did you mean 'admm'?"),
        ("captures --psf psf.png --method mwdn", "`mwdn` is a network"),
        ("captures --psf psf.png --method no.safetensors", "`no.safetensors`"),
        ("captures --psf psf.png --device gpu", "`--device` (gpu) must be one that torch can use here"),
        ("captures --psf psf.png --bit-depth 40", "`--bit-depth` (40) must be 1 to 16."),
        ("captures --psf psf.png --crop 99 99", "`--crop` (99 x 99) must be within the frame (32 x 40)."),
        ("captures --psf psf.png --out captures", "a.png` would overwrite an input"),
        ("captures/a.png --psf psf.png --out psf.png", "`psf.png` must be a folder, but is a file"),
        ("--psf psf.png", "Name at least one capture"),
        ("captures", "`--psf psf.png`, or its camera file, `--camera camera.toml`"),
        ("captures --psf psf.png --methud admm", "Unknown option: --methud. Did you mean --method?"),
        ("captures --psf psf.png --method admm --iteration 9", "Did you mean --iterations?"),
        ("captures --psf psf.png --method pyramid --wrong 9", "Options of the method 'pyramid': --regularisation"),
        ("captures --psf psf.png --method admm --iterations many", "`--iterations` (many) must be a whole number"),
        ("captures --psf psf.png --method admm --iterations 0", "`--iterations` (0)"),
        (
            "captures --psf psf.png --method admm --variation none",
            "`--variation` (none) must be anisotropic, isotropic or",
        ),
        ("captures --psf psf.png --regularisation 1", "Options of the method 'universal': none"),
        ("captures --psf psf.png --format jpeg", "`--format` (jpeg) must be png, png16, tiff, imagej or npy."),
        ("captures --psf psf.png --bin two", "`--bin` (two) must be a whole number."),
        ("captures --psf psf.png --gamma foo", "`--gamma` (foo) must be srgb, a number or none."),
        ("captures --psf psf.png --white-balance foo", "`--white-balance` (foo) must be grey-world, psf, three"),
        ("captures --psf psf.png --crop 3 x", "`--crop` (3 x) must be two whole numbers or none."),
        ("captures --psf psf.png --crop 3", "`--crop` must be followed by two whole numbers or none."),
        ("captures --psf psf.png --map --no-trust", "`--map` needs the check that `--no-trust` skips"),
        ("captures --psf psf.png --psf psf.png", "`--psf` is given more than once."),
        ("captures --psf psf.png --resume --no-resume", "`--resume` and `--no-resume` exclude each other."),
    ],
)
def test_wrong_call_is_one_message_and_exit_2(run, camera, line, message):
    before = {path: path.read_bytes() for path in camera.rglob("*.png")}
    code, out, err = run("reconstruct", *line.split())
    assert code == 2
    assert message in err
    assert (err.startswith("Error: "), len(err.splitlines()), "Traceback" in out) == (True, 1, False)
    assert not (camera / "results").exists()
    assert before == {path: path.read_bytes() for path in camera.rglob("*.png")}


def test_list_of_commands_says_what_each_says_of_itself():
    for name, (place, summary) in COMMANDS.items():
        module, _, function = place.partition(":")
        command = getattr(importlib.import_module(f"mwdn.cli.{module}"), function)
        assert summary == (getattr(command, "help", None) or command.__doc__).partition("\n")[0], name


@pytest.mark.parametrize("command", ["reconstruct", "train", "evaluate", "demo", "simulate", "export", "inspect"])
def test_o_is_out(run, command):
    assert re.search(r"--out,? -o\b", run(command, "--help")[1])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("recunstruct", "No command named 'recunstruct'. Did you mean 'reconstruct'? Known: align, "),
        ("--foo", "No command named '--foo'. Known: align, "),
        ("inspect --psf-bim 2", "Unknown option: --psf-bim. Did you mean --psf-bin? Options: --psf, "),
        ("methods --foo", "Unknown option: --foo. Options: none. See `mwdn methods --help`."),
        ("train", "`RECIPE` is missing. See `mwdn train --help`."),
        ("evaluate admm", "`--data` is missing."),
        ("train a.toml b.toml", "Too many arguments: b.toml."),
        (
            "train a.toml --pictures.size 96 96",
            "Too many arguments: 96. A list of a recipe is one argument, in quotes: '[96, 96]'.",
        ),
        ("demo --pictures dog", "`--pictures` (dog) must be astronaut, coffee or cat."),
        ("design --mask a.npy --pitch-um x", "`--pitch-um` (x) must be a number or none."),
        ("design --foo", "Unknown option: --foo. Name the mask first"),
        ("design lens", "No mask named 'lens'. Did you mean 'lenslets'? Known: array, "),
    ],
)
def test_parser_speaks_as_the_commands_do(run, line, message):
    """Its own boxes break lines at the terminal's width and name Python's types."""
    code, out, err = run(*line.split())
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert err.startswith(f"Error: {message}")


def test_quiet_prints_nothing_but_errors(run, camera):
    code, out, err = run("reconstruct captures/a.png none.png --psf psf.png --out out --method wiener -q")
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert "none.png" in err
    assert run("--quiet", "methods") == run("methods")


def test_verbose_tells_versions_and_the_time(run):
    code, out, err = run("doctor", "-v")
    assert (code, out) == (0, run("doctor")[1])
    first, last = err.splitlines()
    assert f"torch {torch.__version__}" in first
    assert re.fullmatch(r"\d+\.\d s", last)


@pytest.mark.filterwarnings("default")
def test_a_warning_is_one_line(run, camera):
    (camera / "r.toml").write_text('[network]\nname = "mwdn"\n[schedule]\ncourse = "cosine"\n')
    _, _, err = run("train", "r.toml", "--psf", "psf.png")
    first, second = err.splitlines()
    assert first == "Warning: `course` of [schedule] is now called `lr_schedule`. Rename it."
    assert second.startswith("Error: ")


def test_an_option_is_named_as_typed(run, camera):
    assert "`--bin` (0)" in run("reconstruct", "captures", "--psf", "psf.png", "--bin", "0")[2]
    code, _, err = run("reconstruct", "captures", "--psf", "psf.png", "--method", "admm", "--iterations", "-1")
    assert (code, "`--iterations` (-1)" in err) == (2, True)


def test_json_of_reconstruct(run, camera):
    (camera / "d.png").write_bytes(b"")
    line = "reconstruct captures/a.png d.png --psf psf.png --out out --method wiener --json"
    code, out, err = run(line)
    assert code == 1
    assert "1 of 2 captures" in err
    first, last = json.loads(out)
    assert first == {"capture": "captures/a.png", "picture": "out/a.png", **json.loads(Path("out/a.json").read_text())}
    assert first["picture"] == "out/a.png"
    assert last["capture"] == "d.png"
    assert last["picture"] is None
    assert "`d.png`" in last["error"]
    assert json.loads(run(f"{line} --resume --quiet")[1])[0] == first


def test_debug_shows_where_it_comes_from(run, camera):
    code, _, err = run("reconstruct captures --psf none.png --debug")
    assert code == 2
    assert "Traceback" in err
    assert "read_frame" in err
    assert "Error: `none.png` does not exist" in err


def test_existing_output_is_replaced(run, camera):
    assert reconstruct(run, "captures/a.png")[0] == 0
    (camera / "out" / "a.png").write_text("old")
    (camera / "out" / "keep.txt").write_text("mine")
    assert reconstruct(run, "captures/a.png")[0] == 0
    assert read_frame("out/a.png").shape == (*SIZE, 3)
    assert (camera / "out" / "keep.txt").read_text() == "mine"
    assert names(camera / "out") == ["a.json", "a.png", "keep.txt", "summary.png"]


def test_resume_leaves_out_what_is_there(run, camera):
    assert reconstruct(run, "captures/a.png")[0] == 0
    line = "reconstruct captures --psf psf.png --out out --method wiener --resume --no-trust"
    before = (camera / "out" / "a.png").stat().st_mtime_ns
    code, out, _ = run(line)
    assert code == 0
    assert "3 captures reconstructed into out, 1 of them before" in out
    assert (camera / "out" / "a.png").stat().st_mtime_ns == before
    assert "3 captures reconstructed into out\n" in run(f"{line} --regularisation 1e-3")[1]


@pytest.mark.parametrize(
    ("line", "method"),
    [
        ("pyramid --regularisation .01", mwdn.solvers.Pyramid(regularisation=0.01)),
        ("admm --iterations 5 --variation isotropic", mwdn.solvers.Admm(iterations=5, variation="isotropic")),
        ("admm --penalties.data 0.01", mwdn.solvers.Admm(penalties=mwdn.solvers.Penalties(data=0.01))),
        ("wiener --regularisation 1e-3 --boundary zero", mwdn.solvers.Wiener(regularisation=1e-3, boundary="zero")),
        ("wiener --regularisation none", mwdn.solvers.Wiener()),
    ],
)
def test_options_of_a_method(run, camera, line, method):
    options = ("--psf", "psf.png", "--background", "0", "--out", "out", "--format", "npy", "--no-trust")
    code, _, err = run("reconstruct", "captures/a.png", *options, "--method", *line.split())
    assert (code, err) == (0, "")
    calibration = mwdn.Calibration.from_file("psf.png", background=0.0)
    scene = mwdn.Reconstructor(method, calibration, device="cpu")(calibration.correct(read_frame("captures/a.png")))
    assert np.array_equal(read_frame("out/a.npy"), scene[0].movedim(0, -1).numpy())


def test_any_method_can_align(run, camera):
    options = ("captures/a.png", "--psf", "psf.png", "--background", "0", "--format", "npy", "--no-trust")
    assert run("reconstruct", *options, "--method", "wiener", "--align", "--out", "out")[0] == 0
    calibration = mwdn.Calibration.from_file("psf.png", background=0.0)
    scene = mwdn.Reconstructor("wiener", calibration, align=True, device="cpu")(
        calibration.correct(read_frame("captures/a.png"))
    )
    assert np.array_equal(read_frame("out/a.npy"), scene[0].movedim(0, -1).numpy())


def test_methods_lists_all_and_the_options_of_one(run):
    code, out, _ = run("methods")
    assert code == 0
    assert all(name in out for name in (*mwdn.solvers.SOLVERS, *mwdn.networks.NETWORKS, "universal-small"))
    code, out, _ = run("methods", "admm")
    assert code == 0
    assert "iterations: a whole number = 100" in out
    assert "tau, weight of the total variation" in out
    assert "rounds: a whole number = 12" in run("methods", "universal")[1]
    code, _, err = run("methods", "admn")
    assert code == 2
    assert "Did you mean 'admm'?" in err


def test_json_of_the_user_beside_a_capture(run, camera, monkeypatch):
    monkeypatch.setattr("mwdn.cli.reconstruct.Batch", pytest.fail)
    np.save("b.npy", read_frame("captures/b.png"))
    (camera / "b.json").write_text('{"exposure": 8}')
    code, _, err = reconstruct(run, "captures/a.png", "b.npy", out=".")
    assert code == 2
    assert re.search("`b.json`.* would be lost.*`--out`", err)
    assert (camera / "b.json").read_text() == '{"exposure": 8}'


@pytest.mark.parametrize("out", ["raw", "raw/../raw"])
def test_folder_of_the_captures_is_none_for_the_pictures(run, camera, out):
    """A second run would take them for captures."""
    (camera / "raw").mkdir()
    np.save("raw/a.npy", read_frame("captures/a.png"))
    code, _, err = reconstruct(run, "raw", out=out)
    assert code == 2
    assert f"`{out}` holds the captures" in err
    assert names(camera / "raw") == ["a.npy"]
    for _ in range(2):  # a file of it may have its picture beside it
        assert reconstruct(run, "raw/a.npy", out=out)[0] == 0
    np.save("raw/b.npy", read_frame("captures/b.png"))
    (camera / "raw" / "b.png").write_bytes(before := (camera / "captures" / "b.png").read_bytes())
    code, _, err = reconstruct(run, "raw/b.npy", out=out)
    assert (code, "b.png` was not written by mwdn and would be lost" in err) == (2, True)
    assert (camera / "raw" / "b.png").read_bytes() == before


def test_pictures_of_something_else_stay(run, camera):
    """They may be captures that are not among the inputs."""
    (camera / "out").mkdir()
    (camera / "out" / "a.png").write_bytes(before := (camera / "captures" / "b.png").read_bytes())
    code, _, err = reconstruct(run, "captures", out="out")
    assert (code, "out/a.png` was not written by mwdn and would be lost" in err) == (2, True)
    assert (camera / "out" / "a.png").read_bytes() == before
    (camera / "out" / "a.png").rename(camera / "out" / "other.png")
    assert reconstruct(run, "captures", out="out")[0] == 0
    (camera / "out" / "a.json").unlink()  # as of a run that was killed between the two
    assert reconstruct(run, "captures", out="out")[0] == 0


def test_a_full_disk_ends_it_with_one_message(run, camera):
    with full_after(100):
        code, _, err = reconstruct(run, "captures", out="out")
    assert (code, err.count("cannot be written")) == (2, 1)


def test_folder_that_cannot_be_written_to_is_found_first(run, camera, monkeypatch):
    monkeypatch.setattr("mwdn.cli.reconstruct.Reconstructor", pytest.fail)
    code, _, err = reconstruct(run, "captures", out="psf.png/out")
    assert (code, len(err.splitlines())) == (2, 1)
    assert "`psf.png/out` must be a folder that can be written to: Not a directory." in err


def test_line_about_the_psf_is_not_broken(run, camera):
    _, out, _ = reconstruct(run, "captures/a.png")
    assert re.search(r"^PSF \w+, background .* of the full scale subtracted$", out, re.MULTILINE)


@pytest.mark.parametrize("size", [(1, 1), (5, 5), (32, 14)])
def test_psf_too_small_to_judge_by(run, camera, size):
    store("tiny.png", torch.linspace(0.1, 0.9, 3 * size[0] * size[1]).view(1, 3, *size))
    code, _, err = run("reconstruct", "tiny.png", "--psf", "tiny.png", "--background", "0")
    assert code == 2
    assert f"The PSF ({size[0]} x {size[1]}) must have at least 15 pixels along each side" in err
    assert "`--crop`, `--bin`, `--psf-bin`" in err


def test_overexposed_capture_is_named_before_its_psf_is_doubted(run, camera):
    frame = read_frame("captures/a.png")
    top = np.iinfo(frame.dtype).max
    bright = (frame * (top / np.quantile(frame.max(-1), 0.8))).clip(0, top).astype(frame.dtype)
    part = (bright.max(-1) == top).mean()
    assert 0.15 < part < 0.25
    cv2.imwrite("captures/bright.png", bright[..., ::-1])
    code, out, err = reconstruct(run, "captures/bright.png", trust=True)
    assert code == 0
    assert f"Warning: bright.png: {part:.1%} of the capture's pixels are saturated" in err
    assert "`mwdn explain saturation`" in err
    assert (out + err).index("the picture reproduces") > 0
    beside = json.loads((camera / "out" / "bright.json").read_text(encoding="utf-8"))
    (verdict,) = [verdict for verdict in beside["verdicts"] if verdict["topic"] == "saturation"]
    assert (verdict["subject"], verdict["state"]) == ("capture", "doubt")
    assert "saturated" not in reconstruct(run, "captures/a.png", trust=True)[2]


def test_without_trust(run, camera):
    line = ("reconstruct", "captures/a.png", "--psf", "psf.png", "--out", "out", "--method", "wiener", "--no-trust")
    code, out, err = run(*line)
    assert (code, err) == (0, "")
    assert "reproduces" not in out
    assert names(camera / "out") == ["a.json", "a.png", "summary.png"]
    assert set(json.loads((camera / "out" / "a.json").read_text())) == {
        "method",
        "psf_hash",
        "origin",
        "file",
        "bin",
    }


# --- The others ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pictures", "methods"),
    [(PICTURES[-1:], ("pyramid", "wiener")), pytest.param(PICTURES, DEMO_METHODS, marks=pytest.mark.acceptance)],
)
def test_demo(run, tmp_path, monkeypatch, pictures, methods):
    """With one picture and the two fastest methods here; a picture by all of them takes ten seconds."""
    monkeypatch.setattr("mwdn.cli.demo.DEMO_METHODS", methods)
    code, out, err = run("demo", "--out", tmp_path / "demo", "--pictures", *pictures)
    assert (code, err) == (0, "")
    assert names(tmp_path / "demo") == ["captures", "comparison.png", "index.html", "pattern.png", "psf.tif"]
    code, _, err = run(
        f"{out.strip().splitlines()[-1].partition('mwdn ')[2]} --method wiener --no-trust --out {tmp_path}/again"
    )
    assert (code, err) == (0, "")
    rows = {
        words[0]: dict(zip(methods, map(float, words[1:]), strict=True))
        for words in (re.findall(r"[\w.]+", line) for line in out.splitlines() if line.startswith("│"))
    }
    assert set(rows) == set(pictures)
    assert all(row.get("universal", 25) > 24.5 for row in rows.values()), rows
    assert all(row.get("admm", 25) > 24 for row in rows.values()), rows
    assert all(row["pyramid"] > row.get("fista", 24) > row["wiener"] > 15 for row in rows.values()), rows
    assert all(row.get("admm", 25) > row.get("fista", 24) for row in rows.values()), rows
    page = (tmp_path / "demo" / "index.html").read_text(encoding="utf-8")
    assert all(f"<th>{name}</th>" in page for name in rows)
    assert all(f"<td>{value:.2f}</td>" in page for row in rows.values() for value in row.values())
    assert 'src="pattern.png"' in page
    assert 'src="comparison.png"' in page
    assert str(tmp_path / "demo" / "index.html") in out  # on one line, to be clicked or copied
    assert read_frame(tmp_path / "demo" / "comparison.png").shape == (
        26 + len(pictures) * 246,
        (2 + len(methods)) * 246,
        3,
    )


def test_completion_knows_commands_and_options(run, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    script = tmp_path / "mwdn.sh"
    code, out, _ = run("--install-completion", "--shell", "bash", "--output", script)
    assert (code, str(script) in out) == (0, True)
    words = re.findall(r"[\w-]+", script.read_text(encoding="utf-8"))
    assert {*COMMANDS, "contour", "--psf-bin", "--pitch-um", "--quiet", "-q", "--debug"} <= set(words)
    subprocess.run(["bash", "-n", script], check=True)  # valid for bash


def test_recipes_are_listed_and_printed(run):
    code, out, _ = run("recipes")
    assert code == 0
    assert all(name in out for name in packaged_recipes())
    assert run("recipes", "quick-cpu") == (0, find_recipe("quick-cpu").read_text(encoding="utf-8"), "")
    code, _, err = run("recipes", "quick-cpo")
    assert (code, "'quick-cpu'" in err) == (2, True)


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
def test_a_pipe_is_not_printed_as_a_recipe(run, tmp_path):
    """The command waited forever."""
    os.mkfifo(tmp_path / "pipe.toml")
    code, out, err = run("recipes", tmp_path / "pipe.toml")
    assert (code, out, "is a pipe" in err) == (2, "", True)


def test_doctor(run):
    code, out, _ = run("doctor")
    assert code == 0
    for package in ("torch", "numpy", "cyclopts"):
        assert re.search(rf"{package}\s+│\s+{re.escape(importlib.metadata.version(package))}", out)
    assert sys.version.split()[0] in out
    assert "threads" in out
    assert json.loads(run("doctor", "--json")[1])["torch"] == torch.__version__


def test_version_and_help(run):
    assert run("--version") == (0, f"{mwdn.__version__}\n", "")
    for line in ((), ("--help",)):
        code, out, _ = run(*line)
        assert code == 0
        assert all(command in out for command in ("reconstruct", "demo", "doctor", "--debug"))
    code, out, _ = run("reconstruct", "--help")
    assert code == 0
    assert all(option in out for option in ("--psf", "--dark", "--crop", "--bin", "--method", "--out", "--format"))


def test_help_names_options_as_typed_and_no_default_that_does_not_hold(run):
    """It said `psf_gamma`, and that --bin is 1 where the command chooses it."""
    chosen, fixed = (re.sub(r"[\s│]+", " ", run(command, "--help")[1]) for command in ("reconstruct", "evaluate"))
    assert "has its own: --psf-gamma." in chosen
    assert re.search(r"--bin INT [^\[]*\[default: chosen\]", chosen)
    assert re.search(r"--bin INT [^\[]*\[default: 1\]", fixed)


def test_as_a_process(camera):
    line = [sys.executable, "-W", "error", "-m", "mwdn", "reconstruct", "--psf", "psf.png", "--method", "wiener"]
    options = {"capture_output": True, "text": True, "check": False, "timeout": 120}
    done = subprocess.run([*line, "captures/b.png"], **options)
    assert (done.returncode, done.stderr) == (0, "")
    assert read_frame("results/reconstruct/b.png").shape == (*SIZE, 3)
    wrong = subprocess.run([*line[:5], "recipes", "quick-cpi"], **options)  # starts without torch
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("Error: No recipe named 'quick-cpi'. Did you mean 'quick-cpu'?")
    assert len(wrong.stderr.splitlines()) == 1


def test_design_alone_prints_its_help(run):
    code, out, _ = run("design")
    assert code == 0
    assert out.startswith("Usage: mwdn design COMMAND")
