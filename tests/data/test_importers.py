import sys
import types
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image as Pillow

from image_files import dng
from mwdn.calibration import Calibration, FrameFormat
from mwdn.calibration.corrections import Corrections
from mwdn.data import PairFile, import_pairs, read_pairs
from mwdn.data.kinds import Layout
from mwdn.data.pair_checks import DISPLAY_WHITE, REFINED
from mwdn.errors import ImageError, MissingPackageError, ParameterError, UnknownNameError

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def flag(seed=0, height=8, width=10):
    """RGB noise whose top left pixel is red and whose bottom left one is blue."""
    picture = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    picture[0, 0], picture[-1, 0] = RED, BLUE
    return picture


def png(pixels, kind="PNG"):
    data = BytesIO()
    Pillow.fromarray(pixels.squeeze()).save(data, kind)
    return data.getvalue()


def write(path: Path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, content)
    else:
        path.write_bytes(content if isinstance(content, bytes) else png(content))


def authors_file(path, count=3, more=0):
    """As `h5_datamake.py` of the authors' code writes it: OpenCV's channels, moved to the front."""
    scenes = np.stack([flag(i) for i in range(count)])
    captures = np.stack([flag(100 + i) for i in range(count + more)])
    with h5py.File(path, "w") as file:
        for name, pictures in (("gt", scenes), ("blur", captures)):
            bgr = pictures[..., ::-1].transpose(0, 3, 1, 2)
            file.create_dataset(name, data=bgr, maxshape=(None, *bgr.shape[1:]), chunks=True)
    return captures, scenes


def folders(path, count=3):
    for i in range(count):
        write(path / "captures" / f"{i}.png", flag(100 + i, 4, 5))
        write(path / "scenes" / f"{i}.png", flag(i))
    return path


def as_tensor(pixels, peak=255):
    return torch.from_numpy(pixels.astype(np.float32) / np.float32(peak)).movedim(-1, 0)


# The authors' HDF5


def test_a_known_bgr_pixel_of_the_authors_file_arrives_as_rgb(tmp_path):
    captures, scenes = authors_file(tmp_path / "lensless_320.h5")
    done = import_pairs("mwdn", tmp_path / "lensless_320.h5", tmp_path / "pairs.h5")
    assert (done.count, done.skipped) == (3, {})
    with PairFile(tmp_path / "pairs.h5") as pairs:
        assert pairs.attributes == {"source": "mwdn"}
        for i, (measurement, scene) in enumerate(pairs):
            assert scene[:, 0, 0].tolist() == [1, 0, 0]
            assert scene[:, -1, 0].tolist() == [0, 0, 1]
            assert torch.equal(measurement, as_tensor(captures[i]))
            assert torch.equal(scene, as_tensor(scenes[i]))
    with h5py.File(tmp_path / "pairs.h5") as raw:
        assert raw["scene"].dtype == np.uint8
        assert raw["scene"].chunks == (1, 8, 10, 3)


def test_rows_without_a_partner_are_named(tmp_path):
    authors_file(tmp_path / "a.h5", count=3, more=2)
    with pytest.raises(ImageError, match=r"Row 3 of .* \(and 1 more like it\) .*--skip-damaged"):
        import_pairs("mwdn", tmp_path / "a.h5", tmp_path / "pairs.h5")
    done = import_pairs("mwdn", tmp_path / "a.h5", tmp_path / "pairs.h5", skip_damaged=True)
    assert done.count == 3
    assert list(done.skipped) == ["row 3", "row 4"]


def test_numbers_of_another_type_are_named_and_not_the_data_sets(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["blur"] = file["gt"] = np.ones((2, 3, 8, 10), np.float32)
    with pytest.raises(ImageError, match=r"`blur` of .* not \(2, 3, 8, 10\) of float32"):
        import_pairs("mwdn", tmp_path / "a.h5", tmp_path / "pairs.h5")


def test_damaged_rows_and_files_of_the_authors_kind(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name in ("gt", "blur"):
            file.create_dataset(name, data=np.ones((4, 3, 5, 6), "u1"), chunks=(1, 3, 5, 6), fletcher32=True)
        place = file["gt"].id.get_chunk_info(1).byte_offset
    whole = path.read_bytes()
    path.write_bytes(whole[:place] + b"\xff" + whole[place + 1 :])
    with pytest.raises(ImageError, match=r"Row 1 of .*a\.h5` cannot be read"):
        import_pairs("mwdn", path, tmp_path / "pairs.h5")
    done = import_pairs("mwdn", path, tmp_path / "pairs.h5", skip_damaged=True)
    assert (done.count, list(done.skipped)) == (3, ["row 1"])
    path.write_bytes(whole[:-10])
    with pytest.raises(ImageError, match=r"a\.h5` is not a complete HDF5"):
        import_pairs("mwdn", path, tmp_path / "other.h5", skip_damaged=True)
    with pytest.raises(ImageError, match=r"must have `blur`.* has \['measurement', 'scene'\]"):
        import_pairs("mwdn", tmp_path / "pairs.h5", tmp_path / "other.h5")
    with pytest.raises(ParameterError, match="would overwrite an input"):
        import_pairs("mwdn", path, path)
    with pytest.raises(ImageError, match="does not exist"):
        import_pairs("mwdn", tmp_path / "none.h5", tmp_path / "other.h5")
    assert not (tmp_path / "other.h5").exists()


# DiffuserCam


def test_real_diffusercam_pairs_are_turned_exactly(data, tmp_path):
    folder = data / "diffusercam"
    done = import_pairs("diffusercam", folder, tmp_path / "pairs.h5")
    numbers = [10, 11, 43, 65, 157, 189, 326, 408]
    assert (done.count, done.skipped) == (8, {})
    with PairFile(tmp_path / "pairs.h5") as pairs:
        assert (pairs.measurement_shape, pairs.scene_shape) == ((270, 480, 3), (270, 480, 3))
        for number, pair in zip(numbers, pairs, strict=True):  # in the order of numbers, not of letters
            for part, name in zip(pair, ("diffuser_images", "ground_truth_lensed"), strict=True):
                stored = np.load(folder / name / f"im{number}.npy")
                assert np.array_equal(part.movedim(0, -1).numpy(), stored[::-1, :, ::-1])
        assert min(float(measurement.min()) for measurement, _ in pairs) < 0


def test_diffusercam_rows_are_reversed_and_not_rolled(tmp_path):
    capture = np.arange(4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3) / 60
    for folder, pixels in (("diffuser_images", capture), ("ground_truth_lensed", capture / 2)):
        write(tmp_path / folder / "im2.npy", pixels)
        write(tmp_path / folder / "im10.npy", pixels + np.float32(0.1))
    pairs = list(read_pairs("diffusercam", tmp_path))
    assert [name for name, _, _ in pairs] == ["im2", "im10"]
    assert np.array_equal(pairs[0][1], capture[::-1, :, ::-1])
    assert np.array_equal(pairs[0][2], capture[::-1, :, ::-1] / 2)


# Two folders of pictures


def test_folders_are_paired_by_their_stems(tmp_path):
    folders(tmp_path, 12)
    (tmp_path / "scenes" / "10.png").unlink()
    write(tmp_path / "scenes" / "10.jpg", png(flag(10), "JPEG"))
    write(tmp_path / "scenes" / "._11.png", b"left by another system")
    write(tmp_path / "scenes" / "notes.txt", b"no picture")
    names = [name for name, _, _ in read_pairs("folders", tmp_path)]
    assert names == [str(i) for i in range(12)]
    import_pairs("folders", tmp_path, tmp_path / "pairs.h5")
    measurement, scene = PairFile(tmp_path / "pairs.h5")[3]
    assert torch.equal(measurement, as_tensor(flag(103, 4, 5)))
    assert torch.equal(scene, as_tensor(flag(3)))  # as stored: no gamma


def test_the_layout_names_other_folders_and_turns_pictures(tmp_path):
    folders(tmp_path).joinpath("captures").rename(tmp_path / "raw")
    layout, frames = Layout(captures="raw", scene_size=(4, 5)), FrameFormat(bgr=True, upside_down=True)
    (name, measurement, scene), *_ = read_pairs("folders", tmp_path, layout=layout, frames=frames)
    assert name == "0"
    assert np.array_equal(measurement, flag(100, 4, 5)[::-1, :, ::-1])
    assert scene.shape == (4, 5, 3)
    assert np.abs(scene.mean((0, 1)) - flag()[::-1, :, ::-1].mean((0, 1))).max() < 1  # resizing averages areas


def test_deeper_pictures_become_16_bits(tmp_path):
    twelve = np.random.default_rng(0).integers(0, 4096, (4, 6), np.uint16)
    twelve[0, 0] = 4095
    write(tmp_path / "captures" / "a.png", twelve)
    write(tmp_path / "scenes" / "a.png", flag())
    import_pairs("folders", tmp_path, tmp_path / "pairs.h5", frames=FrameFormat(bit_depth=12))
    measurement, scene = PairFile(tmp_path / "pairs.h5")[0]
    assert (measurement - torch.from_numpy(twelve / np.float32(4095))).abs().max() < 1e-5
    assert torch.allclose(scene, as_tensor(flag()).mean(0, keepdim=True), atol=1e-5)  # the camera is grey
    with h5py.File(tmp_path / "pairs.h5") as raw:
        assert raw["measurement"].dtype == raw["scene"].dtype == np.uint16
    import_pairs("folders", tmp_path, tmp_path / "binned.h5", frames=FrameFormat(bit_depth=12, bin=2))
    binned = PairFile(tmp_path / "binned.h5")[0][0]
    assert (binned - torch.nn.functional.avg_pool2d(measurement, 2)).abs().max() < 2e-5
    with pytest.raises(ImageError, match=r"`a`: `bit_depth` \(10\) allows numbers up to 1,023"):
        import_pairs("folders", tmp_path, tmp_path / "no.h5", frames=FrameFormat(bit_depth=10))


def test_grey_scenes_of_a_colour_camera_have_equal_colours(tmp_path):
    write(tmp_path / "captures" / "a.png", flag(1))
    write(tmp_path / "scenes" / "a.png", grey := flag(2)[..., 0])
    _, _, scene = next(read_pairs("folders", tmp_path))
    assert np.array_equal(scene, np.stack([grey] * 3, axis=-1))


@pytest.mark.parametrize("gamma", ["srgb", 1.4])
def test_encoded_scenes_are_decoded_and_captures_stay(tmp_path, gamma):
    write(tmp_path / "captures" / "a.png", flag(1))
    write(tmp_path / "scenes" / "a.png", stored := flag(2))
    _, plain, _ = next(read_pairs("folders", tmp_path))
    _, capture, scene = next(read_pairs("folders", tmp_path, layout=Layout(scene_gamma=gamma)))
    assert np.array_equal(capture, 257 * plain.astype(np.uint16))  # 16 bits, as the decoded scenes
    v = stored / 255
    expected = v**1.4 if gamma == 1.4 else np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    assert np.abs(scene / 65535 - expected).max() < 1e-5


def test_unpaired_files_are_named_before_anything_is_read(tmp_path):
    folders(tmp_path)
    (tmp_path / "scenes" / "2.png").unlink()
    write(tmp_path / "captures" / "0.png", b"damaged")
    with pytest.raises(ImageError, match=r"captures/2\.png` has no partner in `.*scenes`"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5")
    done = import_pairs("folders", tmp_path, tmp_path / "pairs.h5", skip_damaged=True)
    assert done.count == 1
    assert set(done.skipped) == {"0", "2"}
    assert "captures/0.png` must be PNG" in done.skipped["0"]


def test_damaged_and_unlike_pictures(tmp_path):
    folders(tmp_path, 6)
    before = b"the file of yesterday"
    (tmp_path / "pairs.h5").write_bytes(before)
    write(tmp_path / "scenes" / "1.png", png(flag(1))[:-40])
    write(tmp_path / "scenes" / "2.png", flag(2, 9, 10))
    write(tmp_path / "captures" / "3.png", flag(3, 4, 5)[..., :1])
    write(tmp_path / "captures" / "4.png", b"")
    with pytest.raises(ImageError, match=r"scenes/1\.png` is cut off.* To import the others: `--skip-damaged`"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5")
    assert (tmp_path / "pairs.h5").read_bytes() == before
    done = import_pairs("folders", tmp_path, tmp_path / "pairs.h5", skip_damaged=True)
    assert (done.count, list(done.skipped)) == (2, ["1", "2", "3", "4"])
    assert "scene of `2` (9 x 10 x 3, uint8) must be like that of the first pair (8 x 10 x 3" in done.skipped["2"]
    assert "capture of `3` (4 x 5 x 1" in done.skipped["3"]
    assert "`--grey`" in done.skipped["3"]
    assert {file.name for file in tmp_path.iterdir()} == {"captures", "scenes", "pairs.h5"}


def test_a_binned_copy_of_refined_pairs_is_refined(tmp_path):
    """The camera's stray light was subtracted from it a second time."""
    shape = (4, 6, 3)
    marks = {REFINED: "simulate", DISPLAY_WHITE: 0.5, "psf_hash": "of larger pixels"}
    with PairFile.create(tmp_path / "a.h5", measurement_shape=shape, scene_shape=shape, attributes=marks) as file:
        file.append(np.full(shape, 0.5, np.float32), np.full(shape, 0.5, np.float32))
    import_pairs("pairs", tmp_path / "a.h5", tmp_path / "b.h5", frames=FrameFormat(bin=2))
    assert PairFile(tmp_path / "b.h5").attributes == {"source": "pairs", REFINED: "simulate", DISPLAY_WHITE: 0.5}


def test_an_unchanged_copy_of_pairs_keeps_the_camera(tmp_path):
    """It lost the PSF and its hash, so nothing warned of another camera."""
    shape, psf = (4, 6, 3), torch.rand(3, 4, 6)
    marks = {"psf_hash": "some", "pitch_um": 2.0}
    with PairFile.create(
        tmp_path / "a.h5", measurement_shape=shape, scene_shape=shape, attributes=marks, psf=psf
    ) as file:
        file.append(np.full(shape, 0.5, np.float32), np.full(shape, 0.5, np.float32))
    import_pairs("pairs", tmp_path / "a.h5", tmp_path / "b.h5")
    copy = PairFile(tmp_path / "b.h5")
    assert copy.attributes == {"source": "pairs", **marks}
    assert torch.equal(copy.psf[0], psf)


def test_hidden_folders_are_left_out(tmp_path):
    """A notebook's copies of captures ended the import."""
    folders(tmp_path)
    write(tmp_path / "captures" / ".ipynb_checkpoints" / "0-checkpoint.png", flag(0, 4, 5))
    assert len(list(read_pairs("folders", tmp_path))) == 3


def test_floats_of_another_scale_are_refused(tmp_path):
    for folder in ("captures", "scenes"):
        write(tmp_path / folder / "a.npy", np.full((4, 5, 3), 200, np.float32))
    with pytest.raises(ImageError, match=r"`capture of a` \(200 to 200\) must be in \[0, 1\]"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5")


def test_fractions_of_saturation_have_no_bit_depth(tmp_path):
    for folder in ("captures", "scenes"):
        write(tmp_path / folder / "a.npy", np.full((4, 5, 3), 0.5, np.float32))
    with pytest.raises(ImageError, match=r"floats up to 0\.5, but `bit_depth` \(12\)"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5", frames=FrameFormat(bit_depth=12))


def test_scenes_are_turned_upright_and_captures_stay(tmp_path):
    """The display showed the photograph upright; the capture is as the sensor stored it."""
    exif = Pillow.Exif()
    exif[274] = 3
    for folder, seed in (("captures", 100), ("scenes", 0)):
        path = tmp_path / folder / "a.png"
        write(path, flag(seed))
        Pillow.open(path).save(path, exif=exif)
    (_, measurement, scene), *_ = read_pairs("folders", tmp_path)
    assert np.array_equal(measurement, flag(100))
    assert np.array_equal(scene, flag()[::-1, ::-1])


def test_scenes_of_the_frames_size_are_binned_as_the_captures_are(tmp_path):
    for folder, seed in (("captures", 100), ("scenes", 0)):
        write(tmp_path / folder / "a.npy", np.random.default_rng(seed).random((8, 12, 3), np.float32))
    (_, measurement, scene), *_ = read_pairs("folders", tmp_path, frames=FrameFormat(bin=2))
    assert measurement.shape == scene.shape == (4, 6, 3)
    stored = np.load(tmp_path / "scenes" / "a.npy")
    np.testing.assert_allclose(scene, stored.reshape(4, 2, 6, 2, 3).mean((1, 3)), atol=1e-6)


def test_nothing_to_import(tmp_path):
    with pytest.raises(ImageError, match=r"captures` is not a folder.*--captures"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5")
    (tmp_path / "captures").mkdir()
    (tmp_path / "scenes").mkdir()
    with pytest.raises(ImageError, match="has no pair to import"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5")
    write(tmp_path / "captures" / "a.png", flag())
    with pytest.raises(ImageError, match=r"no pair to import\. 1 were skipped; .* has no partner"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5", skip_damaged=True)
    write(tmp_path / "captures" / "a.bmp", flag())
    with pytest.raises(ImageError, match="differ only in their suffix"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5")
    with pytest.raises(ImageError, match="both captures and scenes"):
        import_pairs("folders", tmp_path, tmp_path / "pairs.h5", layout=Layout(captures="scenes"))
    with pytest.raises(ImageError, match=r"nowhere` is not a folder. Check its path"):
        import_pairs("folders", tmp_path / "nowhere", tmp_path / "pairs.h5")
    with pytest.raises(UnknownNameError, match="Did you mean 'folders'"):
        import_pairs("folder", tmp_path, tmp_path / "pairs.h5")


# PhlatCam


def test_phlatcams_raw_captures_and_test_classes(tmp_path):
    mosaic = np.zeros((8, 12), np.uint16)
    mosaic[0::2, 0::2], mosaic[0::2, 1::2], mosaic[1::2, 0::2], mosaic[1::2, 1::2] = 4095, 1000, 3000, 0
    for name in ("n01818515/n01818515_9", "n01818515/n01818515_10", "n09999999/n09999999_1"):
        write(tmp_path / "imagenet_caps_384_12bit_Feb_19" / f"{name}.png", mosaic)
    write(tmp_path / "orig/n01818515/n01818515_9.JPEG", png(flag(1, 50, 70), "JPEG"))
    write(tmp_path / "orig/n01818515/n01818515_10.JPEG", png(flag(1, 500, 400)[..., :1], "JPEG"))
    write(tmp_path / "orig/n09999999/n09999999_1.JPEG", png(flag(2, 384, 384), "JPEG"))
    pairs = list(read_pairs("phlatcam", tmp_path))
    assert [name.split("/")[1] for name, _, _ in pairs] == ["n09999999_1", "n01818515_9", "n01818515_10"]
    for _, capture, scene in pairs:
        assert (capture.shape, scene.shape) == ((4, 6, 3), (384, 384, 3))
        assert np.abs(capture / 65535 - [1, 2000 / 4095, 0]).max() < 1e-5
    binned = next(read_pairs("phlatcam", tmp_path, frames=FrameFormat(bin=2)))[1]
    assert binned.shape == (2, 3, 3)


# Parquet


@pytest.fixture
def shards(tmp_path):
    """As the hub's: structs of bytes and path, in groups of rows, two shards."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'mwdn[parquet]'")
    folder = tmp_path / "data"
    for number, rows in enumerate(([0, 1, 2], [3, 4])):
        write_shard(folder / f"train-0000{number}-of-00002.parquet", rows)
    return folder


def write_shard(path, rows, **replaced):
    import pyarrow
    from pyarrow import parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    cells = {
        "lensless": [{"bytes": png(flag(100 + i, 4, 5)), "path": f"{i}.png"} for i in rows],
        "lensed": [{"bytes": png(flag(i)), "path": None} for i in rows],
    }
    parquet.write_table(pyarrow.table(cells | replaced), path, row_group_size=2)


def test_parquet_shards(shards, tmp_path):
    done = import_pairs("parquet", shards, tmp_path / "pairs.h5")
    assert (done.count, done.skipped) == (5, {})
    for i, (measurement, scene) in enumerate(PairFile(tmp_path / "pairs.h5")):
        assert torch.equal(measurement, as_tensor(flag(100 + i, 4, 5)))
        assert torch.equal(scene, as_tensor(flag(i)))
    one = [name for name, _, _ in read_pairs("parquet", shards / "train-00001-of-00002.parquet")]
    assert one == ["train-00001-of-00002.parquet row 0", "train-00001-of-00002.parquet row 1"]


def test_damaged_rows_and_shards(shards, tmp_path):
    good = png(flag(5))
    cells = [{"bytes": good[:-30]}, {"bytes": None}, {"bytes": good}]
    write_shard(shards / "a.parquet", [7, 8, 9], lensed=cells)
    with pytest.raises(ImageError, match=r"`lensed` of row 0 of `.*a\.parquet` is cut off"):
        import_pairs("parquet", shards, tmp_path / "pairs.h5")
    whole = (shards / "train-00000-of-00002.parquet").read_bytes()
    (shards / "train-00000-of-00002.parquet").write_bytes(whole[:-50])
    with pytest.raises(ImageError, match=r"train-00000-of-00002\.parquet` is not a complete parquet file"):
        import_pairs("parquet", shards, tmp_path / "pairs.h5")
    done = import_pairs("parquet", shards, tmp_path / "pairs.h5", skip_damaged=True)
    assert done.count == 3
    assert list(done.skipped) == ["train-00000-of-00002.parquet", "a.parquet row 0", "a.parquet row 1"]
    assert "must hold the bytes" in done.skipped["a.parquet row 1"]
    with pytest.raises(ImageError, match=r"must have the columns \['x', 'lensed'\], but has \['lensless', 'lensed'\]"):
        import_pairs("parquet", shards / "a.parquet", tmp_path / "no.h5", layout=Layout(captures="x"))


def test_the_hub_needs_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingPackageError, match=r"`owner/name` is not on this machine.*pip install 'mwdn\[hub\]'"):
        import_pairs("parquet", "owner/name", tmp_path / "pairs.h5")
    for name in ("no/such/folder", "data/a.parquet"):
        with pytest.raises(ImageError, match="does not exist"):
            import_pairs("parquet", name, tmp_path / "pairs.h5")


def test_the_hubs_own_words_are_one_line(tmp_path, monkeypatch):
    def snapshot_download(*_, **__):
        raise OSError("No such host.\nPlease check your connection and try again.")

    monkeypatch.setitem(sys.modules, "huggingface_hub", types.SimpleNamespace(snapshot_download=snapshot_download))
    with pytest.raises(ImageError, match=r"from the hub: No such host\. Download it and name its folder\.$"):
        import_pairs("parquet", "owner/name", tmp_path / "pairs.h5")


def test_the_hubs_files_are_read(shards, tmp_path, monkeypatch):
    asked = []

    def snapshot_download(name, **options):
        asked.append((name, options))
        return str(shards)

    hub = types.SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    assert import_pairs("parquet", "owner/name", tmp_path / "pairs.h5").count == 5
    assert asked == [("owner/name", {"repo_type": "dataset", "allow_patterns": "*.parquet"})]


def test_parquet_needs_its_package(tmp_path, monkeypatch):
    write(tmp_path / "a.parquet", b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingPackageError, match=r"the package pyarrow.*`pip install 'mwdn\[parquet\]'`"):
        import_pairs("parquet", tmp_path / "a.parquet", tmp_path / "pairs.h5")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"scene_size": (0, 0)}, r"`scene_size` \(0 x 0\)"),
        ({"scene_size": (-3, 5)}, r"`scene_size` \(-3 x 5\)"),
    ],
)
def test_wrong_numbers_of_a_layout(wrong, said):
    with pytest.raises(ParameterError, match=said):
        Layout(**wrong)


# Corrections of a camera


def camera_of(format, generator):
    """A calibration with a dark frame, a flat field and a map of hot pixels, all different in each channel."""
    dark = generator.integers(5, 40, (6, 8, 3), np.uint8)
    flat = torch.from_numpy(generator.uniform(0.8, 1.2, (1, 3, 6, 8)).astype(np.float32))
    hot = torch.zeros(1, 1, 6, 8, dtype=torch.bool)
    hot[..., 2, 3] = True
    psf = torch.rand(1, 3, 6, 8)
    return Calibration(psf, format, format.normalise(dark), corrections=Corrections(flat, hot))


@pytest.mark.parametrize("bgr", [False, True])
def test_captures_are_corrected_as_the_camera_does(tmp_path, bgr):
    generator = np.random.default_rng(0)
    frames = FrameFormat(bgr=bgr, upside_down=True, bin=2)
    camera = camera_of(frames, generator)
    capture = generator.integers(0, 60, (6, 8, 3), np.uint8)
    stored = capture[..., ::-1] if bgr else capture
    write(tmp_path / "captures" / "0.npy", np.ascontiguousarray(stored))
    write(tmp_path / "scenes" / "0.npy", np.ascontiguousarray(stored))
    _, measurement, _ = next(read_pairs("folders", tmp_path, frames=frames, camera=camera))
    wanted = camera.to_measurement(capture)[0].movedim(0, -1).numpy()
    assert measurement.min() < 0  # not clipped
    assert measurement == pytest.approx(wanted, abs=1e-6)


def test_a_flat_field_may_brighten_the_corners_of_a_capture(tmp_path):
    """A saturated pixel where the flat field is 0.3 became 3.3, which was refused as of another scale."""
    for folder in ("captures", "scenes"):
        write(tmp_path / folder / "0.png", np.tile(np.arange(200, 240, 5, dtype=np.uint8)[:, None], (6, 1, 1)))
    flat = torch.ones(1, 1, 6, 8)
    flat[..., 0] = 0.3
    camera = replace(camera_of(FrameFormat(), np.random.default_rng(0)), dark=None, corrections=Corrections(flat))
    import_pairs("folders", tmp_path, tmp_path / "pairs.h5", camera=camera)
    assert PairFile(tmp_path / "pairs.h5")[0][0].max() == pytest.approx(200 / 255 / 0.3)
    assert PairFile(tmp_path / "pairs.h5")[0][1].max() == pytest.approx(235 / 255)


def test_a_dark_frame_on_another_scale_is_refused(tmp_path):
    write(tmp_path / "captures" / "0.npy", np.full((6, 8, 3), 100, np.uint16))
    write(tmp_path / "scenes" / "0.npy", np.full((6, 8, 3), 100, np.uint16))
    camera = camera_of(FrameFormat(), np.random.default_rng(0))
    with pytest.raises(ImageError, match=r"`bit_depth` of the camera \(None\).*\(12\)"):
        list(read_pairs("folders", tmp_path, frames=FrameFormat(bit_depth=12), camera=camera))


def test_colours_of_a_mosaic_stay_in_order(tmp_path):
    """`bgr` is of the scenes' files: the captures have one channel. It exchanged red and blue of the mosaic."""
    capture = np.tile(np.array([[200, 100], [100, 50]], np.uint8), (3, 4))[..., None]
    write(tmp_path / "captures" / "0.npy", capture)
    write(tmp_path / "scenes" / "0.npy", np.full((3, 4, 3), (50, 100, 200), np.uint8))
    _, measurement, scene = next(read_pairs("folders", tmp_path, frames=FrameFormat(bgr=True, mosaic="rggb")))
    for picture in (measurement, scene):
        assert picture[0, 0] / np.float64(picture.max()) == pytest.approx([1, 0.5, 0.25], abs=1e-3)


def test_captures_may_be_raw_files(tmp_path):
    """Each file states its mosaic; they were left out."""
    rng, frames = np.random.default_rng(0), FrameFormat(mosaic="grbg")
    dark = frames.normalise(rng.integers(0, 2000, (24, 32, 1), np.uint16))
    camera = Calibration(torch.rand(1, 3, 12, 16), frames, dark)
    for name in "ab":
        write(tmp_path / "captures" / f"{name}.DNG", dng(rng.integers(64, 1024, (24, 32), np.uint16), "grbg"))
        write(tmp_path / "scenes" / f"{name}.png", flag(height=12, width=16))
    raw = list(read_pairs("folders", tmp_path))
    corrected = list(read_pairs("folders", tmp_path, frames=frames, camera=camera))
    for (name, capture, _), (_, less_dark, scene) in zip(raw, corrected, strict=True):
        path = tmp_path / "captures" / f"{name}.DNG"
        assert np.abs(capture - FrameFormat().read(path).astype(np.float32)).max() <= 1
        wanted = camera.to_measurement(frames.read(path))[0].movedim(0, -1).numpy()
        assert less_dark == pytest.approx(wanted, abs=1e-6)
        assert scene == pytest.approx(flag(height=12, width=16) / 255, abs=1e-4)
    with pytest.raises(ImageError, match=r"`mosaic` \(rggb\).*`a`.*grbg"):
        list(read_pairs("folders", tmp_path, frames=FrameFormat(mosaic="rggb")))
