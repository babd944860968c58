"""Damaged files of pairs, authors' HDF5 and parquet: taken or refused on one line, within the driver's limits."""

from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np
import pytest
from driver import DURATION_S, damaged, failures, sweep

from image_files import encoded
from mwdn.data import PairFile
from mwdn.data.sources import list_hdf5, list_parquet
from mwdn.errors import ImageError

COUNT, HEIGHT, WIDTH = 3, 8, 10


def pixels(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (COUNT, HEIGHT, WIDTH, 3), np.uint8)


def pairs() -> bytes:
    """As `PairFile.create` writes it, but in memory: the same layout, attributes and PSF."""
    data = BytesIO()
    with h5py.File(data, "w") as file:
        file.attrs.update({"mwdn_pairs": 1, "source": "x", "pitch_um": 6.9})
        for seed, name in enumerate(("measurement", "scene")):
            shape = (HEIGHT, WIDTH, 3)
            rows = file.create_dataset(name, (COUNT, *shape), "u1", maxshape=(None, *shape), chunks=(1, *shape))
            rows[:] = pixels(seed)
        file["psf"] = np.ones((3, HEIGHT, WIDTH), np.float32)
    return data.getvalue()


def authors(**options: object) -> bytes:
    data = BytesIO()
    with h5py.File(data, "w") as file:
        for seed, name in enumerate(("gt", "blur")):
            file.create_dataset(name, data=pixels(seed).transpose(0, 3, 1, 2), **options)
    return data.getvalue()


def shard(**options: object) -> bytes:
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'mwdn[parquet]'")
    from pyarrow import parquet

    cells = {
        name: [{"bytes": encoded(picture, "PNG"), "path": "a.png"} for picture in pixels(seed)]
        for seed, name in enumerate(("lensless", "lensed"))
    }
    data = BytesIO()
    parquet.write_table(pyarrow.table(cells), data, row_group_size=2, **options)
    return data.getvalue()


def read_pairs(path: Path) -> None:
    with PairFile(path) as file:
        assert file.psf is None or file.psf.ndim == 4
        for row in range(len(file)):
            file[row]


def read_all(list_rows: Callable[..., object], captures: str, scenes: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        for source in list_rows(path, captures, scenes).sources:
            source.load()

    return read


def read_shard(path: Path) -> None:
    """A damaged shard is refused in the listing, for those beside it may be whole."""
    listing = list_parquet(path, "lensless", "lensed")
    if listing.refused:
        raise ImageError(next(iter(listing.refused.values())))
    for source in listing.sources:
        source.load()


read_authors = read_all(list_hdf5, "blur", "gt")

FORMATS = {
    "pairs": (pairs, read_pairs),
    "authors": (authors, read_authors),
    "compressed authors": (lambda: authors(chunks=(2, 3, 5, 5), compression="gzip", fletcher32=True), read_authors),
    "parquet": (shard, read_shard),
    "compressed parquet": (lambda: shard(compression="zstd", use_dictionary=False), read_shard),
}


def contents(whole: bytes, seed: int, count: int | None) -> Iterator[bytes]:
    random = np.random.default_rng(seed)
    while count is None or count > 0:
        yield damaged(whole, random)
        count = None if count is None else count - 1


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_pairs(tmp_path: Path, name: str) -> None:
    make, read = FORMATS[name]
    outcomes = sweep(contents(make(), 29, 60), read, tmp_path / "a.h5")
    assert not failures(outcomes), outcomes
    assert outcomes["refused"] > 5


@pytest.mark.acceptance
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_pairs_for_long(tmp_path: Path, name: str) -> None:
    make, read = FORMATS[name]
    outcomes = sweep(contents(make(), 30, None), read, tmp_path / "a.h5", duration_s=DURATION_S / len(FORMATS))
    print(name, dict(outcomes))
    assert not failures(outcomes), outcomes
