"""A command that fails early leaves no folder behind; one that has written keeps it."""

import numpy as np
import pytest

from mwdn.cli.app import main
from mwdn.cli.folders import no_empty_folder

BENCHMARK = """
networks = { wiener = {} }
data.camera = { psf = "psf.npy", photos = "nowhere", test_photos = "nowhere", train = 1, validation = 1, test = 1 }
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Current folder with a PSF, a black capture, an empty folder of photographs and a recipe of a benchmark."""
    monkeypatch.chdir(tmp_path)
    np.save("psf.npy", np.eye(32, dtype=np.float32))
    np.save("black.npy", np.zeros((32, 32), np.float32))
    (tmp_path / "photos").mkdir()
    (tmp_path / "b.toml").write_text(BENCHMARK, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    "line",
    [
        "reconstruct black.npy --psf nowhere.npy",
        "reconstruct black.npy --psf psf.npy --method admn",
        "reconstruct black.npy --psf psf.npy --method wiener",
        "train quick-cpu --psf psf.npy --photos photos",
        "train quick-cpu --psf psf.npy",
        "benchmark b.toml",
        "benchmark nowhere.toml",
        "evaluate wiener --data nowhere.h5 --psf psf.npy",
        "inspect --psf nowhere.npy",
        "simulate photos --psf psf.npy -o new/out/pairs.h5",
        "import folders photos -o new/out/pairs.h5",
    ],
)
def test_no_empty_folder_is_left(here, line, capsys):
    with pytest.raises(SystemExit) as caught:
        main([*line.split(), *([] if "-o" in line else ["-o", "new/out"])])
    assert caught.value.code in (1, 2)
    assert not (here / "new").exists()


def test_what_is_written_or_was_there_stays(tmp_path):
    @no_empty_folder
    def command(*, out=tmp_path / "default", name=None):
        (out / "locks").mkdir(parents=True, exist_ok=True)
        (out / "locks" / "data.lock").touch()
        if name:
            (out / name).touch()
        raise KeyboardInterrupt

    (tmp_path / "empty").mkdir()
    dotted = {"out": tmp_path / "v1.2"}
    for call in ({"out": tmp_path / "a" / "b", "name": "x.png"}, {"out": tmp_path / "empty"}, {}, dotted):
        with pytest.raises(KeyboardInterrupt):
            command(**call)
    assert (tmp_path / "a" / "b" / "x.png").exists()
    assert (tmp_path / "empty").exists()
    assert not (tmp_path / "default").exists()
    assert not (tmp_path / "v1.2").exists()


@pytest.mark.parametrize("line", ["recipes {}", "benchmark {}", "reconstruct {} --psf psf.npy", "import folders {}"])
def test_a_name_that_is_too_long_is_one_line(here, line, capsys):
    """Python's `OSError` reached the terminal as a traceback."""
    with pytest.raises(SystemExit) as caught:
        main(line.format(300 * "a").split())
    assert caught.value.code == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith("Error: ")
    assert "too long" in said[0]


def test_a_black_capture_is_not_interpreted(here, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["interpret", "universal-small", "black.npy", "--psf", "psf.npy", "-o", "new"])
    assert caught.value.code == 2
    assert "saw no light" in capsys.readouterr().err
    assert not (here / "new").exists()
