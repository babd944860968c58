"""EXIF orientation, from every kind of file that can have one."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from image_files import dng, encoded, flag, noise, npy, put, tiff
from mwdn.io.exif import TURNS, orientation
from mwdn.io.images import read_frame, read_picture


def turned(number: int) -> Pillow.Exif:
    exif = Pillow.Exif()
    exif[271], exif[274] = "maker", number
    return exif


@pytest.mark.parametrize("number", range(1, 9))
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WebP", "TIFF"])
def test_orientation_is_read(tmp_path: Path, kind: str, number: int) -> None:
    path = put(tmp_path / "a", encoded(flag(), kind, exif=turned(number)))
    assert orientation(path) == number


def test_orientation_of_raw_files(tmp_path: Path) -> None:
    assert orientation(put(tmp_path / "a.dng", dng(noise("uint16")[:36, :50, 0], turn=8))) == 8


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WebP", "TIFF"])
def test_frames_stay_and_photographs_are_turned(tmp_path: Path, kind: str) -> None:
    """Orientation 6: the file's first row is shown at the right."""
    path = put(tmp_path / "a", encoded(flag(), kind, exif=turned(6), **{"lossless": True} if kind == "WebP" else {}))
    assert read_frame(path).shape == (32, 48, 3)
    assert read_picture(path).shape == (1, 3, 48, 32)
    assert read_picture(path)[0, 0, 0, -1] > 0.9  # red, at the top left of the file


@pytest.mark.parametrize("number", TURNS)
def test_turns_are_those_of_pillow(number: int) -> None:
    picture = Pillow.fromarray(flag())
    picture.getexif()[274] = number
    name = TURNS[number].upper().replace("-", "_")
    from PIL import ImageOps

    np.testing.assert_array_equal(ImageOps.exif_transpose(picture), picture.transpose(Pillow.Transpose[name]))


def test_files_without_the_tag_are_upright(tmp_path: Path) -> None:
    whole = encoded(flag(), "JPEG", exif=turned(6))
    files = [
        whole[:30],
        b"",
        b"P5 2 2 255\n    ",
        b"\xff\xd8",
        encoded(flag(), "BMP"),
        npy(noise()),
        tiff(noise(), bigtiff=True),
    ]
    files += [encoded(flag(), kind) for kind in ("JPEG", "PNG", "WebP", "TIFF")]
    for data in files:
        assert orientation(put(tmp_path / "a", data)) == 1
    assert orientation(tmp_path / "none.jpg") == 1
