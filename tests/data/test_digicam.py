"""Data sets of a camera with a display as its mask: columns or folders, one or several patterns, room light."""

import numpy as np
import pyarrow as pa
import pytest
import torch
from pyarrow import parquet
from test_importers import flag, png, write

from mwdn import Camera, read_frame
from mwdn.calibration import FrameFormat
from mwdn.data import PairFile
from mwdn.data.digicam import DigiCam, import_digicam
from mwdn.errors import ImageError, ParameterError, ShapeError
from mwdn.io.images import write_frame
from mwdn.optics.lcd_mask import Lcd, lcd_psf
from mwdn.optics.psf_measures import likeness
from mwdn.optics.setup import Setup

CAMERA = DigiCam(sensor_mm=2.0)


def patterns(folder, labels, seed=0):
    (folder / "masks").mkdir(parents=True, exist_ok=True)
    for label in labels:
        values = np.random.default_rng(seed + label).integers(0, 2, (18, 8)).astype(np.float32)
        np.save(folder / f"masks/mask_{label}.npy", values)


def shard(path, labels=None, room=False, count=4):
    """A shard as on the hub: encoded pictures in dictionaries, a label in each row."""
    columns = {}
    for name, seed in (("lensless", 100), ("lensed", 0), *((("background", 200),) if room else ())):
        pictures = [flag(seed + i, 38, 50) // (4 if name == "background" else 1) for i in range(count)]
        columns[name] = [{"bytes": png(picture), "path": None} for picture in pictures]
    if labels is not None:
        columns["mask_label"] = labels
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pa.table(columns), path)


def test_each_pattern_gets_its_pairs_and_its_psf(run, tmp_path):
    patterns(tmp_path / "set", (0, 3))
    shard(tmp_path / "set/data/train-0.parquet", labels=[3, 0, 3, 3])
    code, out, err = run("import", "digicam", tmp_path / "set", "--sensor-mm", 2, "-o", tmp_path / "pairs.h5")
    assert (code, err) == (0, "")
    assert "1 pair of mask 0 written" in out
    assert "3 pairs of mask 3 written" in out
    psfs = []
    for label, rows in ((0, [1]), (3, [0, 2, 3])):
        with PairFile(tmp_path / f"pairs-mask-{label}.h5") as pairs:
            assert pairs.attributes == {"source": "digicam", "mask_label": str(label)}
            for row, (measurement, scene) in zip(rows, pairs, strict=True):
                expected = torch.from_numpy(flag(100 + row, 38, 50) / np.float32(255)).movedim(-1, 0)
                assert torch.equal(measurement, expected)
                assert scene[:, 0, 0].tolist() == [1, 0, 0]
            psfs.append(pairs.psf)
        stored = torch.from_numpy(read_frame(tmp_path / f"pairs-mask-{label}-psf.tif")).movedim(-1, 0)[None]
        assert likeness(stored, psfs[-1]) > 0.9999
        expected = CAMERA.psf(tmp_path / f"set/masks/mask_{label}.npy", (38, 50))
        torch.testing.assert_close(psfs[-1], expected)
    assert likeness(*psfs) < 0.7


def test_folders_with_metadata_and_one_room(tmp_path):
    folder = tmp_path / "set"
    patterns(folder, (1, 2))
    for i in range(3):
        write(folder / f"lensless/{i}.png", flag(100 + i, 38, 50))
        write(folder / f"lensed/{i}.png", flag(i, 38, 50))
    write(folder / "background/room.png", flag(7, 38, 50) // 4)
    (folder / "metadata.csv").write_text("file_name,mask_label\nlensless/0.png,1\nlensless/1.png,2\n2.png,1\n")
    done = import_digicam(folder, tmp_path / "pairs.h5", CAMERA)
    assert [(label, count) for label, count in done.files.values()] == [("1", 2), ("2", 1)]
    with PairFile(tmp_path / "pairs-mask-2.h5") as pairs:
        expected = (flag(101, 38, 50).astype(np.float32) - flag(7, 38, 50) // 4) / 255
        np.testing.assert_allclose(pairs[0][0].movedim(0, -1), expected, atol=1e-7)
        assert float(pairs[0][0].min()) < 0
    kept = import_digicam(folder, tmp_path / "kept.h5", DigiCam(sensor_mm=2.0, background="none"))
    with PairFile(next(iter(kept.files))) as pairs:
        assert torch.equal(pairs[0][0].movedim(0, -1), torch.from_numpy(flag(100, 38, 50) / np.float32(255)))


@pytest.mark.parametrize("frames", [FrameFormat(bit_depth=12), FrameFormat(gamma=2.2), FrameFormat(gamma="srgb")])
def test_room_light_is_subtracted_from_linear_light(frames, tmp_path):
    """The bit depth divided twice, and the gamma decoded the difference."""
    folder, times = tmp_path / "set", 16 if frames.bit_depth else 1
    patterns(folder, (0,))
    capture, room = (flag(seed, 38, 50).astype(np.uint16 if frames.bit_depth else np.uint8) * times for seed in (1, 2))
    for name, picture in (("lensless", capture), ("background", room // 4), ("lensed", flag(0, 38, 50))):
        (folder / name).mkdir()
        write_frame(folder / f"{name}/a.png", picture)
    import_digicam(folder, tmp_path / "pairs.h5", CAMERA, frames=frames)
    with PairFile(tmp_path / "pairs.h5") as pairs:
        expected = frames.to_measurement(capture) - frames.to_measurement(room // 4)
        torch.testing.assert_close(pairs[0][0], expected[0], rtol=0, atol=1e-6)


def test_psf_of_cropped_captures_is_that_of_a_smaller_sensor(tmp_path):
    """It was computed as if the whole width of the sensor were in the crop."""
    folder = tmp_path / "set"
    patterns(folder, (0,))
    shard(folder / "a.parquet", labels=[0] * 4)
    whole, crop = FrameFormat(), FrameFormat(crop=(20, 24))
    for name, frames in (("whole", whole), ("crop", crop)):
        import_digicam(folder, tmp_path / f"{name}.h5", CAMERA, frames=frames)
    psfs = [PairFile(tmp_path / f"{name}.h5").psf for name in ("whole", "crop")]
    assert likeness(psfs[0][..., 9:29, 13:37], psfs[1]) > 0.9


def test_the_width_of_a_cropped_sensor_is_that_of_a_readable_capture(tmp_path):
    """It was read from the first one, damaged or not."""
    patterns(tmp_path, (0,))
    for folder in ("lensless", "lensed"):
        (tmp_path / folder).mkdir()
        for name in ("a", "b"):
            (tmp_path / folder / f"{name}.png").write_bytes(png(np.full((38, 50, 3), 90, np.uint8)))
    (tmp_path / "lensless" / "a.png").write_bytes(b"damaged")
    result = import_digicam(
        tmp_path, tmp_path / "p.h5", CAMERA, frames=FrameFormat(crop=(20, 24)), skip_damaged=True
    )  # fmt: skip
    assert list(result.skipped) == ["a"]
    assert len(PairFile(tmp_path / "p.h5")) == 1


def test_metadata_of_subfolders_and_an_empty_line(run, tmp_path):
    folder = tmp_path / "set"
    patterns(folder, (1, 2))
    for name in ("a/0", "b/0"):
        write(folder / f"lensless/{name}.png", flag(5, 38, 50))
        write(folder / f"lensed/{name}.png", flag(6, 38, 50))
    (folder / "metadata.csv").write_text("file_name,mask_label\na/0.png,1\nb/0.png,2\n,\n")
    done = import_digicam(folder, tmp_path / "pairs.h5", CAMERA)
    assert list(done.files.values()) == [("1", 1), ("2", 1)]
    with pytest.raises(ImageError, match=r"`background` \(backgroud\) must be a column or a folder"):
        import_digicam(folder, tmp_path / "pairs.h5", DigiCam(background="backgroud"))


def test_pairs_without_a_pattern_are_skipped_if_wanted(tmp_path):
    folder = tmp_path / "set"
    patterns(folder, (0, 1))
    shard(folder / "a.parquet", labels=[0.0, 1.0, 7.0, None])
    with pytest.raises(ImageError, match=r"a label for each pair.*has none"):
        import_digicam(folder, tmp_path / "pairs.h5", CAMERA)
    done = import_digicam(folder, tmp_path / "pairs.h5", CAMERA, skip_damaged=True)
    assert list(done.files.values()) == [("0", 1), ("1", 1)]
    assert [why.partition("lacks ")[2] for why in done.skipped.values()] == [
        "the pattern `masks/mask_7.npy`.",
        "a mask_label.",
    ]


def test_labels_beside_a_missing_one_are_whole_numbers(tmp_path):
    folder = tmp_path / "set"
    patterns(folder, (0, 1))
    shard(folder / "a.parquet", labels=[0.0, 1.0, 1.0, 1.0])
    assert list(import_digicam(folder, tmp_path / "pairs.h5", CAMERA).files.values()) == [("0", 1), ("1", 3)]


def test_a_column_of_room_light_is_subtracted_and_one_pattern_needs_no_label(tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    np.save(folder / "mask_pattern.npy", np.random.default_rng(1).random((18, 8)).astype(np.float32))
    shard(folder / "test.parquet", room=True)
    done = import_digicam(folder, tmp_path / "pairs.h5", DigiCam(sensor_mm=2.0, psf_turn="rotate-180"))
    assert list(done.files.values()) == [("", 4)]
    with PairFile(tmp_path / "pairs.h5") as pairs:
        expected = (flag(102, 38, 50).astype(np.float32) - flag(202, 38, 50) // 4) / 255
        np.testing.assert_allclose(pairs[2][0].movedim(0, -1), expected, atol=1e-7)
        assert likeness(pairs.psf, CAMERA.psf(folder / "mask_pattern.npy", (38, 50))) < 0.9


def test_what_is_missing_or_damaged_is_named(run, tmp_path):
    folder = tmp_path / "set"
    shard(folder / "a.parquet", labels=[0, 1, 0, 1])
    patterns(folder, (0,))
    with pytest.raises(ImageError, match=r"no pattern `masks/mask_1\.npy`"):
        import_digicam(folder, tmp_path / "pairs.h5")
    shard(folder / "a.parquet")
    patterns(folder, (0, 1))
    with pytest.raises(ImageError, match="must have one pattern"):
        import_digicam(folder, tmp_path / "pairs.h5")
    (folder / "masks/mask_1.npy").unlink()
    (folder / "b.parquet").write_bytes((folder / "a.parquet").read_bytes()[:200])
    with pytest.raises(ImageError, match=r"b\.parquet"):
        import_digicam(folder, tmp_path / "pairs.h5")
    done = import_digicam(folder, tmp_path / "pairs.h5", CAMERA, skip_damaged=True)
    assert (list(done.files.values()), list(done.skipped)) == ([("", 4)], ["b.parquet"])
    code, _, err = run("import", "parquet", folder, "--source-mm", "200", "-o", tmp_path / "x.h5")
    assert (code, "Only the kind digicam" in err) == (2, True)


def test_a_display_casts_the_shadow_of_its_cells():
    """Close to the sensor there is no diffraction: one open cell is a rectangle of its own colour and size."""
    setup = Setup(distance_mm=0.01, source_mm=1e6, pixels=(200, 200), pixel_um=6.0, bin=1)
    cells = torch.zeros(9, 3)
    cells[4, 1] = 1  # the middle cell of the middle column, in a green row
    with pytest.raises(ParameterError, match="no light of a colour"):
        lcd_psf(cells, setup)
    cells[3:6, 1] = 1
    psf = lcd_psf(cells, setup)
    assert psf.shape == (1, 3, 200, 200)
    for channel, row in enumerate((3, 4, 5)):
        lit = psf[0, channel] > 0.3 * psf[0, channel].max()
        rows, columns = lit.nonzero().T
        height, width = ((place.max() - place.min() + 1) * 6.0 for place in (rows, columns))
        assert float(height) == pytest.approx(60, abs=12)
        assert float(width) == pytest.approx(180, abs=12)
        assert float(rows.float().mean() - 100) * 6 == pytest.approx((row - 4) * 73.03, abs=9)
    torch.testing.assert_close(psf.sum((-2, -1)), torch.ones(1, 3))
    assert Camera(psf).sensor_size == (200, 200)
    with pytest.raises(ShapeError, match="rows, columns"):
        lcd_psf(torch.zeros(2, 3, 4), setup)
    with pytest.raises(ParameterError, match=r"must be in \[0, 1\]"):
        lcd_psf(2 * cells, setup)
    with pytest.raises(ParameterError, match="opening_um"):
        Lcd(opening_um=(80.0, 180.0))
