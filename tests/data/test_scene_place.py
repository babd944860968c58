"""Scenes in the frame of their captures, and the authors' file, as their code would read and write it."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from mwdn.calibration import FrameFormat
from mwdn.cli.app import main
from mwdn.data import PairFile, import_pairs, read_pairs
from mwdn.data.kinds import Layout
from mwdn.errors import ImageError, ParameterError

NUMBERS = np.random.default_rng(1)


def noise(*shape):
    return NUMBERS.integers(0, 256, (*shape, 3), np.uint8)


def write(path: Path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))


@pytest.fixture
def distributed(tmp_path):
    """The authors' data as distributed, blur/ and gt/, and what it holds."""
    captures, scenes = [noise(320, 320) for _ in range(3)], [noise(137, 137) for _ in range(3)]
    for number, (capture, scene) in enumerate(zip(captures, scenes, strict=True)):
        write(tmp_path / "theirs" / "blur" / f"{number}.png", capture)
        write(tmp_path / "theirs" / "gt" / f"{number}.png", scene)
    return tmp_path / "theirs", captures, scenes


def test_the_authors_folders_are_their_file(distributed, tmp_path):
    """`h5_datamake.py` pads by 94 in front and 89 behind, channels blue first and in front."""
    folder, captures, scenes = distributed
    import_pairs("mwdn", folder, tmp_path / "pairs.h5")
    import_pairs("mwdn", folder, tmp_path / "theirs.h5", authors=True)
    padded = [np.pad(scene, ((94, 89), (94, 89), (0, 0))) for scene in scenes]
    with h5py.File(tmp_path / "theirs.h5") as file:
        assert set(file) == {"gt", "blur"}
        assert file["gt"].dtype == np.uint8
        assert np.array_equal(file["gt"], np.stack(padded)[..., ::-1].transpose(0, 3, 1, 2))
        assert np.array_equal(file["blur"], np.stack(captures)[..., ::-1].transpose(0, 3, 1, 2))
        assert file["gt"].maxshape == (None, 3, 320, 320)
    import_pairs("mwdn", tmp_path / "theirs.h5", tmp_path / "again.h5")
    for name in ("pairs.h5", "again.h5"):
        for (measurement, scene), capture, true in zip(PairFile(tmp_path / name), captures, padded, strict=True):
            assert torch.equal((255 * measurement).round().byte(), torch.from_numpy(capture).movedim(-1, 0))
            assert torch.equal((255 * scene).round().byte(), torch.from_numpy(true).movedim(-1, 0))


def test_a_file_of_pairs_becomes_the_authors(tmp_path):
    with PairFile.create(tmp_path / "a.h5", measurement_shape=(4, 6, 3), scene_shape=(4, 6, 3)) as file:
        file.append(torch.full((3, 4, 6), 0.2), torch.tensor([0.0, 0.6, 1.5])[:, None, None].expand(3, 4, 6))
    import_pairs("pairs", tmp_path / "a.h5", tmp_path / "theirs.h5", authors=True)
    with h5py.File(tmp_path / "theirs.h5") as file:
        assert np.unique(file["blur"]).tolist() == [51]
        assert file["gt"][0, :, 0, 0].tolist() == [255, 153, 0]


def test_placed_scenes_are_binned_with_their_captures(distributed, tmp_path):
    folder, captures, scenes = distributed
    _, capture, scene = next(read_pairs("mwdn", folder, frames=FrameFormat(bin=2)))
    padded = np.pad(scenes[0], ((94, 89), (94, 89), (0, 0))) / 255
    for got, full in ((scene, padded), (capture, captures[0] / 255)):
        expected = full.reshape(160, 2, 160, 2, 3).mean((1, 3))
        assert np.abs(got / 65535 - expected).max() < 1e-5


def test_scene_place_counts_upright_rows_of_the_cropped_frame(tmp_path):
    write(tmp_path / "captures" / "a.png", noise(12, 14))
    write(tmp_path / "scenes" / "a.png", scene := noise(3, 4))
    layout, frames = Layout(scene_place=(1, 2)), FrameFormat(crop=(8, 10), upside_down=True)
    _, capture, placed = next(read_pairs("folders", tmp_path, layout=layout, frames=frames))
    assert capture.shape == placed.shape == (8, 10, 3)
    assert np.array_equal(placed[1:4, 2:6] // 257, scene[::-1])  # 16 bits, as cropped captures
    assert placed.sum(dtype=int) == 257 * scene.sum(dtype=int)


def test_phlatcams_scenes_are_in_the_middle(tmp_path):
    for name, picture in (("imagenet_caps_384_12bit_Feb_19", np.ones((8, 12), np.uint16)), ("orig", noise(2, 2))):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "n1_1.png"), picture)
    _, capture, scene = next(read_pairs("phlatcam", tmp_path, layout=Layout(scene_size=(2, 4))))
    assert capture.shape == scene.shape == (4, 6, 3)
    outside = scene.copy()
    outside[1:3, 1:5] = 0
    assert outside.sum() == 0 < scene[1:3, 1:5].min() + 1


@pytest.mark.parametrize("crop", [(300, 300), (260, 310)])
def test_the_authors_place_is_known_in_the_middle_of_their_frames(distributed, tmp_path, crop):
    folder, captures, scenes = distributed
    _, capture, scene = next(read_pairs("mwdn", folder, frames=FrameFormat(crop=crop)))
    padded = np.pad(scenes[0], ((94, 89), (94, 89), (0, 0)))
    top, left = ((320 - length) // 2 for length in crop)
    middle = np.s_[top : top + crop[0], left : left + crop[1]]
    assert np.array_equal(capture // 257, captures[0][middle])
    assert np.array_equal(scene // 257, padded[middle])


def test_a_scene_without_a_place_is_no_silent_success(tmp_path, capsys):
    """The place is published for 320 x 320 pixels. Other files were written without a word."""
    write(tmp_path / "theirs" / "blur" / "0.png", noise(40, 40))
    write(tmp_path / "theirs" / "gt" / "0.png", noise(17, 17))
    line = ["import", "mwdn", str(tmp_path / "theirs"), "-o", str(tmp_path / "pairs.h5")]
    with pytest.raises(SystemExit) as ended:
        main(line)
    assert ended.value.code == 0
    assert "17 x 17" in (said := capsys.readouterr().err)
    assert "--scene-place" in said
    with pytest.raises(SystemExit) as ended:
        main([*line[:-1], str(tmp_path / "authors.h5"), "--authors"])
    assert ended.value.code == 2
    assert "--scene-place" in capsys.readouterr().err
    assert not (tmp_path / "authors.h5").exists()


@pytest.mark.parametrize("place", [(184, 0), (0, 184)])
def test_a_scene_must_lie_within_the_frame(distributed, tmp_path, place):
    with pytest.raises(ImageError, match=r"137 x 137.*320 x 320.*--scene-place"):
        import_pairs("mwdn", distributed[0], tmp_path / "pairs.h5", layout=Layout(scene_place=place))


def test_a_place_is_not_negative():
    with pytest.raises(ParameterError, match=r"`scene_place` \(-1, 3\)"):
        Layout(scene_place=(-1, 3))


def test_the_command_writes_both_files(distributed, tmp_path):
    folder, *_ = distributed
    for options in ([], ["--authors"], ["--scene-place", "10", "20"]):
        with pytest.raises(SystemExit) as end:
            main(["import", "mwdn", str(folder), "-o", str(tmp_path / f"{len(options)}.h5"), *options])
        assert end.value.code == 0
    assert h5py.File(tmp_path / "1.h5")["gt"].shape == (3, 3, 320, 320)
    scene = PairFile(tmp_path / "3.h5")[0][1]
    assert scene[:, :10].sum() == scene[..., :20].sum() == 0 < scene[:, 10, 20:157].sum()
