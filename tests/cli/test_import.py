import sys

import numpy as np
import pytest

from mwdn.cli.app import main
from mwdn.data import PairFile
from mwdn.io.images import write_linear, write_picture


def run(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main(["import", *map(str, arguments)])
    return stopped.value.code


@pytest.fixture
def folders(tmp_path, generator):
    import torch

    for i in range(3):
        for folder in ("captures", "scenes"):
            write_picture(tmp_path / folder / f"[{i}].png", torch.rand(1, 3, 6, 7, generator=generator))
    write_picture(tmp_path / "psf.png", torch.rand(1, 3, 6, 7, generator=generator) * 0.9)
    return tmp_path


def test_import_writes_pairs_and_says_so(folders, capsys):
    out = folders / "new" / "pairs.h5"
    assert run("folders", folders, "-o", out) == 0
    assert len(PairFile(out)) == 3
    shown = capsys.readouterr().out
    assert shown.splitlines()[-1] == f"3 pairs written to {out}, 0 skipped"


def test_files_that_are_not_read_are_named(folders, capsys):
    """Scenes of a camera's raw files were left out without a word."""
    for name in ("scenes/a.dng", "captures/b.txt", "scenes/c.gif"):
        (folders / name).touch()
    (folders / "captures/[0].json").touch()
    assert run("folders", folders, "-o", folders / "pairs.h5") == 0
    said = capsys.readouterr().err
    assert all(name in said for name in ("a.dng", "b.txt", "c.gif"))
    assert ".json" not in said


def test_camera_file_says_how_captures_are_stored(folders, tmp_path):
    (tmp_path / "camera.toml").write_text('psf = "psf.png"\ncrop = [4, 6]\nbin = 2\nwhite_balance = "psf"\n')
    assert run("folders", folders, "-o", tmp_path / "pairs.h5", "--camera", tmp_path / "camera.toml") == 0
    assert PairFile(tmp_path / "pairs.h5").measurement_shape == (2, 3, 3)


def test_camera_file_corrects_captures(folders, tmp_path, capsys):
    """It said that the dark frame is not subtracted; the flat field and the hot pixels were ignored without a word."""
    np.save(tmp_path / "flat.npy", np.full((6, 7, 1), 0.8, np.float32))
    (tmp_path / "camera.toml").write_text('psf = "psf.png"\nflat_field = "flat.npy"\n')
    assert run("folders", folders, "-o", tmp_path / "pairs.h5") == 0
    assert run("folders", folders, "-o", tmp_path / "flat.h5", "--camera", tmp_path / "camera.toml") == 0
    plain, corrected = (PairFile(tmp_path / name)[1][0] for name in ("pairs.h5", "flat.h5"))
    assert corrected.max() > 1.1  # not clipped
    assert np.allclose(corrected, plain / 0.8, atol=1e-4)
    assert run("pairs", tmp_path / "pairs.h5", "-o", tmp_path / "new.h5", "--camera", tmp_path / "camera.toml") == 2
    assert "corrected already" in " ".join(capsys.readouterr().err.split())


def test_background_of_the_psf_is_not_the_room_light_of_digicam(folders, tmp_path):
    """Each camera file that was made with dark frames has one."""
    (tmp_path / "camera.toml").write_text('psf = "psf.png"\nbackground = 0.0\n')
    assert run("folders", folders, "-o", tmp_path / "pairs.h5", "--camera", tmp_path / "camera.toml") == 0


def test_what_is_skipped_is_named(folders, capsys):
    (folders / "scenes" / "[1].png").write_bytes(b"no picture")
    (folders / "captures" / "[2].png").unlink()
    out = folders / "pairs.h5"
    assert run("folders", folders, "-o", out) == 2
    problem = " ".join(capsys.readouterr().err.split())
    assert "has no partner" in problem
    assert "--skip-damaged" in problem
    assert not out.exists()
    assert run("folders", folders, "-o", out, "--skip-damaged") == 0
    shown = capsys.readouterr()
    assert shown.out.splitlines()[-1] == f"1 pair written to {out}, 2 skipped: [2], [1]"
    assert shown.err.count("skipped:") == 2
    assert "[1].png" in shown.err


def test_an_existing_file_stays_when_the_import_fails(folders, capsys):
    out = folders / "pairs.h5"
    assert run("folders", folders, "-o", out) == 0
    before = out.read_bytes()
    (folders / "scenes" / "[2].png").write_bytes(b"no picture")
    assert run("folders", folders, "-o", out) == 2
    assert out.read_bytes() == before
    assert "Traceback" not in capsys.readouterr().err


def test_the_layout_is_given_by_options(tmp_path):
    import torch

    picture = torch.from_numpy(np.arange(6 * 4 * 3, dtype=np.float32).reshape(3, 6, 4) / 72)
    write_linear(tmp_path / "a" / "x.npy", picture)
    write_linear(tmp_path / "b" / "x.npy", picture)
    options = ["--captures", "a", "--scenes", "b", "--bgr", "--upside-down", "--scene-size", "3", "2", "--bin", "2"]
    assert run("folders", tmp_path, "-o", tmp_path / "pairs.h5", *options) == 0
    measurement, scene = PairFile(tmp_path / "pairs.h5")[0]
    expected = torch.nn.functional.avg_pool2d(picture.flip(0, 1), 2)
    assert torch.allclose(measurement, expected, atol=1e-6)
    assert torch.allclose(scene, expected, atol=1e-6)


def test_unknown_kind(tmp_path, capsys):
    assert run("diffusecam", tmp_path) == 2
    assert "Did you mean 'diffusercam'?" in " ".join(capsys.readouterr().err.split())


def test_the_extra_to_install_survives_the_terminals_markup(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert run("parquet", "owner/name", "-o", tmp_path / "pairs.h5") == 2
    assert "pip install 'mwdn[hub]'" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", ["captures/[2].png", "captures/new.png", "pairs"])
def test_no_picture_is_replaced(folders, capsys, name):
    before = {path: path.read_bytes() for path in folders.rglob("*.png")}
    assert run("folders", folders, "-o", folders / name) == 2
    assert "must end in .h5 or .hdf5" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in folders.rglob("*") if path.is_file()}


@pytest.mark.parametrize("option", ["--bin 0", "--bit-depth 0", "--scene-size -3 5"])
def test_wrong_numbers_are_one_message(folders, capsys, option):
    assert run("folders", folders, "-o", folders / "pairs.h5", *option.split()) == 2
    assert capsys.readouterr().err.count("\n") == 1
