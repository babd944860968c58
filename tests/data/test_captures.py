"""Real captures: which files are some, and how they become measurements."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from made import touch
from mwdn.calibration import Calibration, FrameFormat
from mwdn.data.captures import find_captures, list_captures, read_capture, read_captures
from mwdn.errors import ImageError, ParameterError, ShapeError
from mwdn.io.exif import orientation


def test_captures_are_found_in_order_and_once(tmp_path):
    b, a, _, upper = touch(tmp_path / "in", "b.png", "a.tif", "notes.txt", "c.PNG")
    (tmp_path / "in" / "d.npy").mkdir()
    single = touch(tmp_path, "single.raw")[0]  # named by the user: its content decides
    assert find_captures([single, tmp_path / "in"]) == [single, a, b, upper]
    assert find_captures([b, str(tmp_path / "in"), b]) == [b, a, upper]


@pytest.mark.parametrize("as_folder", [True, False])
def test_psf_and_dark_frame_are_no_captures(tmp_path, as_folder):
    """`mwdn reconstruct *.tif` names them, too."""
    a, psf, dark, _ = touch(tmp_path, "a.png", "psf.png", "dark.npy", "._a.png")
    (tmp_path / "link.png").symlink_to(psf)
    paths = [tmp_path] if as_folder else [dark, a, psf, tmp_path / "link.png"]
    files, skipped = list_captures(paths, exclude={"PSF": psf, "dark frame": dark})
    assert files == [str(a)]
    for text in ("dark.npy (the dark frame)", "psf.png (the PSF)", "link.png (the PSF)"):
        assert text in " ".join(skipped)


def test_every_file_of_a_folder_is_read_or_named(tmp_path):
    touch(tmp_path, "a.png", "b.DNG", "c.webp", "camera.toml", "a.json", ".hidden.txt")
    touch(tmp_path, "notes.txt", "phone.heic", "film.gif", *[f"film_{n}.mp4" for n in range(5)])
    (tmp_path / "day 2").mkdir()
    files, skipped = list_captures([tmp_path, tmp_path])
    assert [name.removeprefix(f"{tmp_path}/") for name in files] == ["a.png", "b.DNG", "c.webp"]
    pictures, folders, others = skipped
    assert "film.gif and phone.heic" in pictures
    assert "day 2/" in folders
    assert "film_0.mp4, film_1.mp4 and 4 more" in others


def test_a_pipe_and_a_link_to_itself_do_not_end_a_folder(tmp_path):
    """They are listed, so that reading each names its fault, and the good captures beside them are read."""
    touch(tmp_path, "good.png")
    (tmp_path / "loop.png").symlink_to("loop.png")
    os.mkfifo(tmp_path / "pipe.png")
    assert [Path(path).name for path in list_captures([tmp_path]).files] == ["good.png", "loop.png", "pipe.png"]
    for name, fault in {"loop.png": "leads back to itself", "pipe.png": "is a pipe"}.items():
        assert orientation(tmp_path / name) == 1
        with pytest.raises(ImageError, match=fault):
            FrameFormat().read(tmp_path / name)


def test_nothing_to_reconstruct(tmp_path):
    with pytest.raises(ParameterError, match="Name at least one capture"):
        find_captures([])
    with pytest.raises(ParameterError, match=r"The folder `.*` holds no capture\. Readable: .*\.bmp, .*\.npy"):
        find_captures([tmp_path])
    psf, _ = touch(tmp_path, "psf.png", "photo.heic")
    with pytest.raises(ParameterError, match=r"psf\.png \(the PSF\)"):
        find_captures([psf], exclude={"PSF": psf})
    with pytest.raises(ParameterError, match=r"photo\.heic.*psf\.png \(the PSF\)"):
        find_captures([tmp_path], exclude={"PSF": psf})


def test_a_pattern_in_quotes_stands_for_its_files(tmp_path):
    b, a, _, odd = touch(tmp_path, "b.png", "a.png", "c.tif", "[1].png")
    assert find_captures([tmp_path / "[ab].png"]) == [a, b]
    assert find_captures([odd]) == [odd]  # a file of this name
    with pytest.raises(ParameterError, match=r"No file matches `.*\*\.jpg`"):
        find_captures([tmp_path / "*.jpg"])
    with pytest.raises(ParameterError, match="is an address, not a file"):
        find_captures(["https://example.com/a.png"])


def test_captures_are_corrected_by_the_calibration(tmp_path):
    """Twice as large, 4 bits, dark level 3, upside down, blue first: all of it must be undone."""
    stored = np.full((4, 6, 3), 3, np.uint8)
    stored[2:, :2] = 3 + np.array([8, 4, 2], np.uint8)  # BGR; the file's lower left
    np.save(tmp_path / "a.npy", stored)
    np.save(tmp_path / "b.npy", np.full((4, 6, 3), 15, np.uint8))
    dark = torch.full((1, 1, 4, 6), 3 / 15)
    frames = FrameFormat(bgr=True, bit_depth=4, bin=2, upside_down=True)
    calibration = Calibration(torch.ones(1, 3, 2, 3) / 6, frames, dark)
    both = read_captures([tmp_path / "a.npy", tmp_path / "b.npy"], calibration)
    expected = torch.zeros(2, 3, 2, 3)
    expected[0, :, 0, 0] = torch.tensor([2, 4, 8]) / 15
    expected[1] = 12 / 15
    torch.testing.assert_close(both, expected)
    assert torch.equal(read_capture(tmp_path / "b.npy", calibration), both[1:])


def test_captures_of_different_channels(tmp_path):
    for name, channels in (("a", 3), ("b", 1)):
        np.save(tmp_path / f"{name}.npy", np.zeros((2, 3, channels), np.uint8))
    files = [tmp_path / "a.npy", tmp_path / "b.npy"]
    with pytest.raises(ShapeError, match=r"b\.npy` \(1 channels\) must have as many as the captures before it \(3\)"):
        read_captures(files, Calibration(torch.ones(1, 1, 2, 3) / 6))


def test_capture_that_does_not_fit_is_named(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 6, 3), np.uint8))
    with pytest.raises(ShapeError, match=r"`.*a\.npy`: `psf` \(2 x 3\) and the capture \(4 x 6\) must have the same"):
        read_captures([tmp_path / "a.npy"], Calibration(torch.ones(1, 1, 2, 3) / 6))
