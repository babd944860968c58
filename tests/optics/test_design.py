"""`mwdn design` as a user types it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from mwdn import Calibration, read_frame
from mwdn.cli.app import main
from mwdn.optics import Contour, Diffuser, Setup, mask_psf
from mwdn.optics.design import design_camera
from mwdn.optics.mask_files import read_mask

SMALL = ["--aperture-mm", "0.4", "0.4", "--pixels", "200", "240", "--wavelengths", "2", "-o", "cam"]


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        with pytest.raises(SystemExit) as caught:
            main(["design", *map(str, arguments)])
        return (caught.value.code or 0, *capsys.readouterr())

    return call


@pytest.mark.parametrize(
    "line",
    [
        "contour --size-mm 0.5 0.5 --iterations 3",
        "diffuser --size-mm 0.5 0.5",
        "lenslets --size-mm 0.5 0.5 --levels 16",
        "zone --size-mm 0.5 0.5 --zone-um 100",
        "coded --order 4 --distance-mm 0.5",
        "coded --pattern mura --order 13 --distance-mm 0.5",
        "pinholes --size-mm 0.4 0.4 --count 3",
    ],
)
def test_every_mask_becomes_a_camera(run, tmp_path, line):
    code, out, err = run(*line.split(), *SMALL)
    assert (code, err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "cam").iterdir()) == [
        "camera.json",
        "mask.tif",
        "preview.png",
        "psf.tif",
    ]
    about = json.loads((tmp_path / "cam/camera.json").read_text())
    calibration = Calibration.from_file("cam/psf.tif", background=0.0)
    assert calibration.size == (50, 60)
    assert about["made"]["psf_hash"] == calibration.psf_hash
    assert calibration.psf_hash in out
    assert about["mask"]["name"] == line.split()[0]
    # The PSF can be computed again from the files.
    setup = {name: tuple(value) if isinstance(value, list) else value for name, value in about["setup"].items()}
    again = mask_psf(read_mask("cam/mask.tif"), Setup(**setup))
    again = again / again.sum((-2, -1), keepdim=True)
    torch.testing.assert_close(again, calibration.psf, rtol=0.01, atol=2e-3 * float(again.max()))
    assert read_frame("cam/preview.png").shape[0] == 26 + 246


@pytest.mark.parametrize("about", [None, "{}", "[]", "no JSON", '{"made": 1}'])
@pytest.mark.parametrize("taken", ["psf.tif", "mask.tif", "preview.png", "mask.stl"])
def test_only_another_design_is_replaced(run, tmp_path, monkeypatch, taken, about):
    monkeypatch.setattr("mwdn.optics.design.design_camera", pytest.fail)
    (tmp_path / "cam").mkdir()
    (tmp_path / "cam" / taken).write_text("measured")
    if about is not None:
        (tmp_path / "cam" / "camera.json").write_text(about)
    code, _, err = run("diffuser", "--size-mm", "0.5", "0.5", *SMALL, "--stl")
    assert code == 2
    assert f"`cam/{taken}` would be replaced" in err
    assert (tmp_path / "cam" / taken).read_text() == "measured"


def test_another_design_is_replaced(run, tmp_path):
    line = ("pinholes", "--size-mm", "0.4", "0.4", *SMALL, "--count")
    hashes = []
    (tmp_path / "cam").mkdir()
    (tmp_path / "cam" / "mask.stl").write_text("not asked for")
    for count in (3, 4):
        code, _, err = run(*line, count)
        assert (code, "Warning: `cam/mask.stl` is from before" in err, "mask.gds" in err) == (0, True, False)
        hashes.append(json.loads((tmp_path / "cam/camera.json").read_text())["made"]["psf_hash"])
    assert len(set(hashes)) == 2
    assert (tmp_path / "cam" / "mask.stl").read_text() == "not asked for"


def test_fabrication_files(run, tmp_path):
    pytest.importorskip("gdstk")
    assert run("contour", "--size-mm", "0.4", "0.4", *SMALL, "--gds", "--stl", "--stl-every", "2")[0] == 0
    assert (tmp_path / "cam/mask.gds").stat().st_size > 1000
    assert (tmp_path / "cam/mask.stl").stat().st_size == 84 + 50 * (2 * 100 * 100 + 3 * 4 * 100)


def test_recipe_stands_behind_the_command_line(run, tmp_path):
    (tmp_path / "mine.toml").write_text('size-mm = [0.4, 0.4]\nfeature-um = 40.0\nseed = 7\nsource-mm = "inf"\n')
    assert run("diffuser", "--recipe", "mine.toml", "--seed", "8", *SMALL)[0] == 0
    about = json.loads((tmp_path / "cam/camera.json").read_text())
    assert about["mask"]["feature_um"] == 40.0
    assert about["mask"]["seed"] == 8
    assert about["setup"]["source_mm"] is None


@pytest.mark.parametrize(("recipe", "mask"), [("mwdn", "contour"), ("diffuser", "diffuser"), ("coded", "coded")])
def test_recipes_of_the_project_are_understood(run, recipe, mask):
    """Every key of the recipe is read; the only error is the wrong number on the command line."""
    code, _, err = run(mask, "--recipe", f"camera-{recipe}", "--pitch-um", "-1")
    assert (code, err) == (2, "Error: `--pitch-um` (-1) must be positive.\n")


def test_recipe_of_the_paper_is_the_default(run, monkeypatch):
    calls = []
    monkeypatch.setattr("mwdn.cli.design.Output.write", lambda self, *arguments: calls.append(arguments))
    assert run("contour", "--recipe", "camera-mwdn")[0] == 0
    assert calls == [("contour", Contour(), Setup())]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("contour --levels 0", "Error: `--levels` (0) must be 2 to 65,536."),
        ("contour --distance-mm -2", "Error: `--distance-mm` (-2) must be positive."),
        ("diffuser --pitch-um 9", "Error: `--pitch-um` (9) cannot sample"),
        ("contour --recipe none.toml", "Error: The recipe `none.toml` does not exist."),
        ("contour --levls 3", "Did you mean --levels?"),
        ("kontour", "Did you mean 'contour'?"),
        ("--mask none.npy", "`none.npy` does not exist"),
        ("--mask a.npy --levls 3", "Did you mean --levels?"),
        ("pinholes --stl --size-mm 0.4 0.4 --count 2", "no heights for an STL"),
        ("diffuser --stl --size-mm 0.4 0.4 --stl-every 0", "Error: `--stl-every` (0) must be at least 1."),
        ("diffuser --size-mm 0.4 0.4 --stl-every 2", "`--stl-every` needs `--stl`"),
        ("--mask a.npy --values amplitude --pitch-um 2 --levels 4 --index 2", "leave out `--index`, `--levels`"),
        ("--mask a.npy --values height --pitch-um 2 --phase-nm 532", "leave out `--phase-nm`"),
    ],
)
def test_wrong_call_is_one_message_and_exit_2(run, tmp_path, line, message):
    np.save(tmp_path / "a.npy", np.ones((8, 8)))
    code, out, err = run(*line.split(), *SMALL)
    assert code == 2
    assert message in " ".join(err.split())
    assert "Traceback" not in out + err
    assert not (tmp_path / "cam").exists()


def test_a_mask_from_a_file(run, tmp_path):
    """The mask.tif of a design gives the same PSF; `mwdn design --mask` is short for `mwdn design array --mask`."""
    assert run("pinholes", "--size-mm", "0.4", "0.4", "--count", "3", *SMALL)[0] == 0
    for name, line in (("one", ["array", "--mask", "cam/mask.tif"]), ("two", ["--mask=cam/mask.tif"])):
        code, _, err = run(*line, *SMALL[:-1], name)
        assert (code, err) == (0, "")
        about = json.loads((tmp_path / name / "camera.json").read_text())
        assert about["mask"]["mask"] == "cam/mask.tif"
        assert about["made"] == json.loads((tmp_path / "cam/camera.json").read_text())["made"]
    code, _, err = run("--mask", "cam/mask.tif", *SMALL)
    assert (code, "would overwrite an input" in err) == (2, True)
    np.save(tmp_path / "heights.npy", np.eye(8))
    for line in (["array", "--mask", "heights.npy"], ["--mask", "heights.npy"]):
        assert "`--values height --pitch-um 2`" in run(*line, *SMALL)[2]
    assert "--values" in run("--mask", "heights.npy", "--help")[1]


def test_an_opaque_mask_leaves_the_design_before_it(run, tmp_path):
    """mask.tif was replaced, and psf.tif stayed that of the earlier mask."""
    np.save(tmp_path / "open.npy", np.ones((100, 100), np.float32))
    np.save(tmp_path / "closed.npy", np.zeros((100, 100), np.float32))
    line = ["--values", "amplitude", "--pitch-um", "4", *SMALL]
    assert run("--mask", "open.npy", *line)[0] == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "cam").iterdir()}
    assert len(before) == 4
    code, _, err = run("--mask", "closed.npy", *line)
    assert (code, "No light passes the mask within the aperture" in err) == (2, True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "cam").iterdir()} == before


def test_designed_camera_keeps_its_light():
    setup = Setup(aperture_mm=(0.4, 0.4), pixels=(200, 200), wavelengths=2)
    designed = design_camera("diffuser", Diffuser(size_mm=(0.5, 0.5)), setup)
    torch.testing.assert_close(designed.psf.sum((-2, -1)), torch.ones(1, 3))
    assert designed.stored.max() == 1
    assert 0.9 < designed.light.sum((-2, -1)).min() <= designed.light.sum((-2, -1)).max() < 1.02
    other = design_camera("diffuser", replace(Diffuser(size_mm=(0.5, 0.5)), seed=1), setup)
    assert other.report()["made"]["psf_hash"] != designed.report()["made"]["psf_hash"]


def test_sensitivity_falls_with_the_distance_from_where_the_psf_was_taken(run, tmp_path):
    status, _, message = run("diffuser", "--size-mm", "0.5", "0.5", *SMALL, "--sensitivity")
    assert status == 0, message
    likeness = json.loads((tmp_path / "cam" / "camera.json").read_text())["likeness"]
    angles = likeness["angle_degrees"]
    # The pattern of such a small aperture moves, but hardly changes.
    assert all(0.8 < value < 1 for value in angles.values())
    assert "10" not in angles  # the pitch of 2 um cannot sample it
    near, half, far = (likeness["source_mm"][key] for key in ("50", "100", "800"))
    assert 0.8 < near < half < 1
    assert near < far < 1  # the wave from far away is nearly flat already
