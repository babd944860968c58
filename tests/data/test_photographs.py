"""The middle squares of a folder of photographs."""

import cv2
import numpy as np
import pytest
import torch

from mwdn.data.photographs import Photographs
from mwdn.errors import ImageError, ParameterError
from mwdn.io.images import srgb_decode


def store(path, pixels):
    """Write RGB or grey bytes, as they are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels))


def noise(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def light(pixels):
    """What `Photographs` gives for these (H, W, 3) bytes."""
    return srgb_decode(torch.from_numpy(pixels.astype(np.float32)) / 255).movedim(-1, 0)[None]


@pytest.mark.parametrize(("shape", "top", "left"), [((20, 31), 0, 5), ((31, 20), 5, 0), ((20, 20), 0, 0)])
def test_middle_square_with_its_colours(tmp_path, shape, top, left):
    pixels = noise(*shape, 3)
    store(tmp_path / "a.png", pixels)
    found = Photographs(tmp_path, side=20).light(torch.tensor([0]))
    torch.testing.assert_close(found, light(pixels[top : top + 20, left : left + 20]), rtol=0, atol=1e-6)


def test_red_is_the_first_channel(tmp_path):
    store(tmp_path / "red.png", np.full((8, 8, 3), (255, 0, 0), np.uint8))
    found = Photographs(tmp_path, side=8).light(torch.tensor([0]))
    assert found.mean((0, 2, 3)).tolist() == [1.0, 0.0, 0.0]


def test_shrinking_averages(tmp_path):
    """Blocks of 4 x 4 pixels of one byte each: the middle of 16 x 24 shrinks to 4 x 4 without any change."""
    small = noise(4, 4, 3)
    large = small.repeat(4, 0).repeat(4, 1)
    store(tmp_path / "a.png", np.concatenate([noise(16, 4, 3), large, noise(16, 4, 3)], axis=1))
    torch.testing.assert_close(Photographs(tmp_path, side=4).light(torch.tensor([0])), light(small), rtol=0, atol=1e-6)


def test_grey_has_three_equal_colours(tmp_path):
    pixels = noise(9, 9)
    store(tmp_path / "grey.png", pixels)
    found = Photographs(tmp_path, side=9).light(torch.tensor([0, 0]))
    assert found.shape == (2, 3, 9, 9)
    torch.testing.assert_close(found[:1], light(np.stack([pixels] * 3, -1)), rtol=0, atol=1e-6)


def test_turned_upright_as_its_exif_says(tmp_path):
    """A phone held upright stores its picture on its side and says so: 6 is a quarter turn clockwise."""
    side = np.zeros((32, 32, 3), np.uint8)
    side[:16, :16] = 255  # top left of the file; top right of the picture
    encoded = cv2.imencode(".jpg", side)[1].tobytes()
    tag = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    exif = b"\xff\xe1" + (len(tag) + 2).to_bytes(2) + tag
    (tmp_path / "phone.jpg").write_bytes(encoded[:2] + exif + encoded[2:])
    found = Photographs(tmp_path, side=32).light(torch.tensor([0]))[0, 0]
    assert found[:16, 16:].mean() > 0.9
    assert found[:, :16].mean() < 0.1


def test_nested_folders_in_order(tmp_path):
    for number, name in enumerate(["b/2.png", "a/deep/1.png", "c.png"]):
        store(tmp_path / name, np.full((4, 4, 3), 60 * number, np.uint8))
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "album.png").mkdir()
    found = Photographs(tmp_path, side=4)
    assert found.names == ["1.png", "2.png", "c.png"]
    levels = found.light(torch.arange(3)).mean((1, 2, 3))
    torch.testing.assert_close(levels, srgb_decode(torch.tensor([60, 0, 120]) / 255))
    assert Photographs(tmp_path, side=4, limit=2).names == ["1.png", "2.png"]


def test_split_is_disjoint_and_whole(tmp_path):
    for number in range(10):
        store(tmp_path / f"{number}.png", np.full((4, 4, 3), 20 * number, np.uint8))
    photographs = Photographs(tmp_path, side=4)
    training, validation = photographs.split(4)
    assert validation.names == ["3.png", "7.png"]
    assert sorted(training.names + validation.names) == photographs.names
    for part in (training, validation):
        levels = part.light(torch.arange(len(part)))[:, 0, 0, 0]
        expected = srgb_decode(torch.tensor([20 * int(name[0]) for name in part.names]) / 255)
        torch.testing.assert_close(levels, expected)
    few = photographs.split(11)
    assert [len(part) for part in few] == [10, 10]


def test_nothing_to_read(tmp_path):
    (tmp_path / "notes.txt").write_text("no picture")
    with pytest.raises(ParameterError, match=r"The folder `.*` holds no photograph\. Readable: \.bmp"):
        Photographs(tmp_path)


def test_bad_files_are_named(tmp_path):
    store(tmp_path / "good.png", noise(8, 8, 3))
    whole = (tmp_path / "good.png").read_bytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ImageError, match=r"half\.png` is cut off"):
        Photographs(tmp_path)
    (tmp_path / "half.png").unlink()
    store(tmp_path / "deep.png", noise(8, 8, 3).astype(np.uint16) * 257)
    with pytest.raises(ImageError, match=r"deep\.png` holds uint16; photographs for training must have 8 bits"):
        Photographs(tmp_path)


def test_hidden_files_are_no_photographs(tmp_path):
    """macOS puts a hidden ._a.png beside each a.png on foreign disks; it holds no picture."""
    store(tmp_path / "a.png", noise(8, 8, 3))
    (tmp_path / "._a.png").write_bytes(b"Mac OS X")
    assert Photographs(tmp_path, side=8).names == ["a.png"]
