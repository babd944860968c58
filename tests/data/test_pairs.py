import multiprocessing
import os
import pickle
import re
import threading
from concurrent.futures import ThreadPoolExecutor

import h5py
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from full_disk import full_after
from mwdn.data import PairFile
from mwdn.errors import ImageError, ParameterError, ShapeError

MEASUREMENT, SCENE = (6, 9, 3), (8, 10, 3)


def batch(count, generator):
    return tuple(torch.rand(count, shape[2], *shape[:2], generator=generator) for shape in (MEASUREMENT, SCENE))


def create(path, dtype="float32", **options):
    return PairFile.create(path, measurement_shape=MEASUREMENT, scene_shape=SCENE, dtype=dtype, **options)


@pytest.fixture
def pairs(tmp_path, generator):
    measurement, scene = batch(12, generator)
    with create(tmp_path / "pairs.h5") as file:
        file.append(measurement[:5], scene[:5])
        file.append(measurement[5:], scene[5:])
        assert len(file) == 12
    return tmp_path / "pairs.h5", measurement, scene


def test_what_goes_in_comes_out_exactly(pairs):
    path, measurement, scene = pairs
    with PairFile(path) as file:
        assert (len(file), file.measurement_shape, file.scene_shape) == (12, MEASUREMENT, SCENE)
        for i, (m, s) in enumerate(file):
            assert torch.equal(m, measurement[i])
            assert torch.equal(s, scene[i])
            assert m.is_contiguous()
        assert torch.equal(file[-1][0], measurement[-1])
        assert torch.equal(file[np.int64(3)][1], scene[3])
        for outside in (12, -13):
            with pytest.raises(IndexError, match="has 12 pairs"):
                file[outside]


def test_several_pairs_at_once_are_refused(pairs, unchecked):
    for index in (slice(0, 2), 1.0, [0, 1], None):
        with pytest.raises(ParameterError, match=r"`index` .*Subset"):
            PairFile(pairs[0])[index]


def test_noise_below_zero_survives_as_float_and_is_clipped_as_integer(tmp_path):
    noisy = torch.full((1, 3, *MEASUREMENT[:2]), -0.01)
    for dtype, value in (("float32", -0.01), ("uint8", 0.0), ("uint16", 0.0)):
        with create(tmp_path / "a.h5", dtype) as file:
            file.append(noisy, torch.ones(1, 3, *SCENE[:2]))
        measurement, scene = PairFile(tmp_path / "a.h5")[0]
        assert (measurement == value).all()
        assert (scene == 1).all()


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_integers_are_rounded_to_the_nearest_and_kept_exactly(tmp_path, generator, dtype):
    peak = np.iinfo(dtype).max
    measurement, scene = batch(2, generator)
    stored = np.random.default_rng(0).integers(0, peak, SCENE, dtype, endpoint=True)
    with create(tmp_path / "a.h5", dtype) as file:
        file.append(measurement, scene)
        file.append(measurement[0], stored)
    with h5py.File(tmp_path / "a.h5") as raw:
        assert raw["scene"].dtype == dtype
        assert np.array_equal(raw["scene"][2], stored)
    file = PairFile(tmp_path / "a.h5")
    assert (file[0][0] - measurement[0]).abs().max() <= 0.5001 / peak
    assert torch.equal(file[2][1], torch.from_numpy(stored / np.float32(peak)).movedim(-1, 0))


def test_bfloat16_is_stored_exactly_as_float32(tmp_path, generator):
    measurement, scene = (part.bfloat16() for part in batch(2, generator))
    with create(tmp_path / "a.h5") as file:
        file.append(measurement, scene)
    assert torch.equal(PairFile(tmp_path / "a.h5")[1][0], measurement[1].float())


def test_eight_bits_are_exact_in_sixteen(tmp_path):
    levels = np.resize(np.arange(256, dtype=np.uint8), SCENE)
    with create(tmp_path / "a.h5", "uint16") as file:
        file.append(np.zeros(MEASUREMENT, np.uint8), levels)
    with h5py.File(tmp_path / "a.h5") as raw:
        assert np.array_equal(raw["scene"][0], levels * np.uint16(257))


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_one_raw_chunk_a_sample(tmp_path, generator, dtype):
    with create(tmp_path / "a.h5", dtype) as file:
        file.append(*batch(7, generator))
    with h5py.File(tmp_path / "a.h5") as raw:
        for name, shape in (("measurement", MEASUREMENT), ("scene", SCENE)):
            data = raw[name]
            assert data.chunks == (1, *shape)
            assert data.maxshape == (None, *shape)
            assert data.compression is None
            assert data.id.get_create_plist().get_nfilters() == 0
            assert data.id.get_num_chunks() == 7
            size = data.dtype.itemsize * np.prod(shape)
            assert {data.id.get_chunk_info(i).size for i in range(7)} == {size}


def test_attributes_and_psf(tmp_path, generator):
    psf = torch.rand(1, 3, 5, 7, generator=generator)
    attributes = {"psf_hash": "0123abcd", "pitch_um": 6.9, "exposure": 12, "camera": "Kamera 1, grün"}
    with create(tmp_path / "a.h5", attributes=attributes, psf=psf):
        pass
    file = PairFile(tmp_path / "a.h5")
    assert file.attributes == attributes
    assert {type(value) for value in file.attributes.values()} == {str, float, int}
    assert torch.equal(file.psf, psf)
    assert len(file) == 0
    with create(tmp_path / "b.h5") as _:
        pass
    assert PairFile(tmp_path / "b.h5").psf is None
    assert PairFile(tmp_path / "b.h5").attributes == {}


def test_the_file_appears_only_at_success(tmp_path, pairs):
    path, measurement, _ = pairs
    before = path.read_bytes()
    with pytest.raises(OSError, match="of the user"):  # noqa: PT012, SIM117
        with create(path) as file:
            file.append(np.zeros(MEASUREMENT), np.zeros(SCENE))
            assert path.read_bytes() == before
            raise OSError("of the user's own, which must come through unchanged")
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["pairs.h5"]
    with create(path) as file:
        file.append(np.zeros(MEASUREMENT), np.zeros(SCENE))
    assert len(PairFile(path)) == 1
    with pytest.raises(ImageError, match="not open"):
        file.append(measurement, measurement)


@pytest.mark.parametrize("attributes", [None, {"source": "x"}])
@pytest.mark.parametrize("limit", [0, 1000, 5000, 100_000, 383_000])
def test_a_full_disk_stops_at_its_pair_and_keeps_the_old_file(tmp_path, limit, attributes):
    """HDF5 called such files complete, with zeros for pairs, or ended the process with a segmentation fault."""
    path = tmp_path / "pairs.h5"
    path.write_bytes(b"old")
    shape, pixels = (40, 40, 3), np.full((40, 40, 3), 7, np.uint8)
    new = PairFile.create(path, measurement_shape=shape, scene_shape=shape, dtype="uint8", attributes=attributes)
    with (
        full_after(limit),
        pytest.raises(ImageError, match=r"pairs.h5` cannot be written.*: File too large\. Make") as error,
    ):
        write(new, pixels, 40)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    # 9,600 bytes a pair, and 2 to 12 kB of metadata.
    expected = {100_000: "at pair (9|10|11):", 383_000: "at pair (39|40):"}
    assert re.search(expected.get(limit, "at pair [12]:"), str(error.value))


def write(file, pixels, count):
    with file:
        for _ in range(count):
            file.append(pixels, pixels)


@pytest.mark.parametrize(("method", "workers"), [("fork", 2), ("spawn", 1)])  # a spawned one imports torch: 2 s
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_workers_read_what_was_written(pairs, method, workers):
    path, measurement, scene = pairs
    file = PairFile(path)
    assert torch.equal(file[3][0], measurement[3])  # opened in the parent before the workers start
    loader = DataLoader(file, batch_size=3, num_workers=workers, multiprocessing_context=method)
    for _ in range(2 if method == "fork" else 1):
        read = [torch.cat(parts) for parts in zip(*loader, strict=True)]
        assert torch.equal(read[0], measurement)
        assert torch.equal(read[1], scene)
    assert torch.equal(file[4][1], scene[4])  # the parent's own handle still works


def _child(file, queue):
    ((inherited, _),) = file._opened.values()
    file[0]
    queue.put((list(file._opened) == [os.getpid()], bool(inherited)))


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_a_forked_process_opens_the_file_anew(pairs):
    file = PairFile(pairs[0])
    file[0]
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=_child, args=(file, queue))
    process.start()
    assert queue.get(timeout=600) == (True, False)
    process.join()
    assert list(file._opened) == [os.getpid()]
    assert torch.equal(file[0][0], pairs[1][0])


def test_threads_may_open_it_together(pairs, monkeypatch):
    """One that came while another one was opening the file read from data sets that were not there yet."""
    together = threading.Barrier(4, timeout=60)
    first = PairFile(pairs[0])
    is_same = PairFile._is_same
    monkeypatch.setattr(PairFile, "_is_same", lambda self, file: together.wait() >= 0 and is_same(self, file))
    with ThreadPoolExecutor(4) as threads:
        for number, (measurement, _) in enumerate(threads.map(first.__getitem__, range(4))):
            assert torch.equal(measurement, pairs[1][number])
    assert torch.equal(first[5][1], pairs[2][5])


def test_it_can_be_pickled_and_closed_and_read_again(pairs):
    path, measurement, _ = pairs
    file = PairFile(path)
    file[0]
    copy = pickle.loads(pickle.dumps(file))
    assert torch.equal(copy[1][0], measurement[1])
    file.close()
    file.close()
    assert torch.equal(file[1][0], measurement[1])


def test_a_file_cut_off_anywhere_is_refused(pairs, tmp_path):
    whole = pairs[0].read_bytes()
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.h5").write_bytes(whole[:size])
        with pytest.raises(ImageError, match=r"cut\.h5` is not a complete HDF5 file.*mwdn import"):
            PairFile(tmp_path / "cut.h5")


def test_foreign_files_are_named(tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(ImageError, match=r"a\.h5` does not exist"):
        PairFile(path)
    path.write_text("hello")
    with pytest.raises(ImageError, match="is not a complete HDF5"):
        PairFile(path)
    contents = [
        ({"gt": np.zeros(1), "blur": np.zeros(1)}, "mwdn import mwdn"),
        ({"x": np.zeros(1)}, r"must have the data set `measurement`, but has \['x'\]"),
        ({"measurement": np.zeros((2, 3, 3, 3), "u1")}, "`scene`"),
        ({"measurement": np.zeros((2, 3, 3)), "scene": np.zeros(2)}, r"`measurement` .* must be \(N, H, W, C\)"),
        ({"measurement": np.zeros((2, 3, 3, 3), "i4"), "scene": np.zeros(2)}, "int32"),
        ({"measurement": np.zeros((2, 3, 3, 3), "u1"), "scene": np.zeros((3, 3, 3, 3), "u1")}, "2 measurements and 3"),
    ]
    for content, message in contents:
        with h5py.File(path, "w") as raw:
            for name, array in content.items():
                raw[name] = array
        with pytest.raises(ImageError, match=message):
            PairFile(path)
    with create(path):
        pass
    with h5py.File(path, "a") as raw:
        raw.attrs["mwdn_pairs"] = 2
    with pytest.raises(ImageError, match="version 2"):
        PairFile(path)


def test_a_damaged_row_is_named(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as raw:  # another program's file, with checksums
        for name in ("measurement", "scene"):
            raw.create_dataset(name, data=np.ones((4, 5, 5, 3), "u1"), chunks=(1, 5, 5, 3), fletcher32=True)
        place = raw["scene"].id.get_chunk_info(2).byte_offset
    damaged = bytearray(path.read_bytes())
    damaged[place] ^= 255
    path.write_bytes(damaged)
    file = PairFile(path)
    assert (file[1][1] == 1 / 255).all()
    with pytest.raises(ImageError, match=r"`scene` 2 of `.*a\.h5` cannot be read"):
        file[2]


def test_wrong_calls(tmp_path, generator, unchecked):
    measurement, scene = batch(2, generator)
    with create(tmp_path / "a.h5") as file:
        with pytest.raises(ShapeError, match=r"`scene` \(2 x 6 x 9 x 3.* must be 8 x 10 x 3"):
            file.append(measurement, measurement)
        with pytest.raises(ShapeError, match=r"`measurement` \(1\) and `scene` \(2\) must match"):
            file.append(measurement[0], scene)
        with pytest.raises(ShapeError):
            file.append(torch.zeros(3), scene)
        with pytest.raises(ParameterError, match=r"`measurement` \(.* to 255\) must be in \[0, 1\]"):
            file.append(measurement / measurement.max() * 255, scene)
        with pytest.raises(ParameterError, match="`scene`"):
            file.append(measurement, scene * torch.nan)
        with pytest.raises(ParameterError, match="int64"):
            file.append(np.zeros(MEASUREMENT, int), scene[0])
        with pytest.raises(ParameterError, match=r"`measurement` .* must be a tensor or an array"):
            file.append([[0.5]], scene[0])
        assert len(file) == 0
    with pytest.raises(ParameterError, match="`scene_shape`"):
        PairFile.create(tmp_path / "b.h5", measurement_shape=MEASUREMENT, scene_shape=(3, 0, 3))
    with pytest.raises(ParameterError, match="1 channel or 3"):  # the file could be written, and never read
        PairFile.create(tmp_path / "b.h5", measurement_shape=(6, 7, 2), scene_shape=MEASUREMENT)
    with pytest.raises(ParameterError, match="`dtype`"):
        create(tmp_path / "b.h5", "int8")
    with pytest.raises(ParameterError, match="'shape' is list"):
        create(tmp_path / "b.h5", attributes={"shape": [1]})
    with pytest.raises(ShapeError, match="`psf`"):
        create(tmp_path / "b.h5", psf=torch.zeros(3, 3))
    with pytest.raises(ParameterError, match=r"`psf` .* must be a tensor"):
        create(tmp_path / "b.h5", psf=np.zeros((1, 3, 3)))
    with pytest.raises(ImageError, match="is a folder"), create(tmp_path):
        pass
    (tmp_path / "photo.png").touch()
    (tmp_path / "link.h5").symlink_to(tmp_path / "photo.png")
    for name in ("photo.png", "link.h5"):
        with pytest.raises(ParameterError, match=r"`photo.png` must end in .h5 or .hdf5.*: `photo.h5`"):
            create(tmp_path / name)
    for name in ("photo.png", "link.h5"):
        (tmp_path / name).unlink()
    with pytest.raises(ImageError, match="cannot be written"), create(tmp_path / "a.h5" / "b.h5"):
        pass
    assert [file.name for file in tmp_path.iterdir()] == ["a.h5"]


def test_channels_that_are_not_last_are_refused(tmp_path):
    """The width was taken for the channels, and `mwdn import pairs` copied the file."""
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        for name in ("measurement", "scene"):
            file[name] = np.zeros((2, 3, 16, 20), np.float32)
    with pytest.raises(ImageError, match="1 or 3 channels last"):
        PairFile(tmp_path / "pairs.h5")
