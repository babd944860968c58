"""Files of pairs, and authors' files, that reach for other files or claim more than they hold."""

import os

import h5py
import numpy as np
import pytest
import torch

from mwdn.capture.recording import Replay, record
from mwdn.capture.source import CameraFrame
from mwdn.data import PairFile
from mwdn.data.hdf5 import read_attributes
from mwdn.data.sources import list_hdf5
from mwdn.errors import ImageError

SHAPE = (2, 3, 3, 3)


def virtual(file, name, source):
    layout = h5py.VirtualLayout(SHAPE, "u1")
    layout[:] = h5py.VirtualSource(source, name, SHAPE)
    file.create_virtual_dataset(name, layout)


def bomb(file, name, _):
    """Three chunks of 268 MB of zeros, which gzip makes 261 kB; here one byte each, for they are never read."""
    data = file.create_dataset(name, (1, 3, 16384, 16384), "u1", chunks=(1, 1, 16384, 16384), compression="gzip")
    for channel in range(3):
        data.id.write_direct_chunk((0, channel, 0, 0), b"0")


def short(file, name, _):
    """HDF5 2.0 took the checksum from in front of the chunk: a segmentation fault."""
    data = file.create_dataset(name, SHAPE, "u1", chunks=SHAPE, compression="gzip", fletcher32=True)
    data.id.write_direct_chunk((0, 0, 0, 0), b"012")


CONTENTS = {
    "a short chunk": (short, "has a chunk of less than 4 bytes"),
    "an odd filter": (
        lambda file, name, _: file.create_dataset(name, SHAPE, "u1", chunks=SHAPE, scaleoffset=0),
        "is packed by the filters",
    ),
    "external link": (lambda file, name, other: file.update({name: h5py.ExternalLink(other, name)}), "is a link"),
    "soft link": (lambda file, name, _: file.update({name: h5py.SoftLink("/elsewhere")}), "is a link"),
    "virtual": (virtual, "is stored in other files"),
    "external storage": (
        lambda file, name, other: file.create_dataset(name, SHAPE, "u1", external=[(other, 0, 54)]),
        "is stored in other files",
    ),
    "nothing written": (
        lambda file, name, _: file.create_dataset(name, (10**12, 3, 3, 3), "u1", chunks=(1, 3, 3, 3)),
        "must hold 27,000,000,000,000 bytes",
    ),
    "no numbers": (lambda file, name, _: file.create_dataset(name, (10**12, 0, 3, 3), "u1"), "must hold 0 bytes"),
    "a bomb": (bomb, "805,306,368 bytes; at most 536,870,912"),
}


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("kind", ["pairs", "authors"])
@pytest.mark.parametrize("other", ["file", "pipe"])
def test_only_what_is_in_the_file_is_read(tmp_path, content, kind, other):
    """Such files reached any readable file, hung on pipes, and took the memory of what they claim."""
    put, message = CONTENTS[content]
    names = ("measurement", "scene") if kind == "pairs" else ("gt", "blur")
    if other == "pipe":
        os.mkfifo(tmp_path / "other.h5")
    else:
        with h5py.File(tmp_path / "other.h5", "w") as file:
            file.update({name: np.ones(SHAPE, "u1") for name in names})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in names:
            put(file, name, str(tmp_path / "other.h5"))
    with pytest.raises(ImageError, match=message):
        PairFile(tmp_path / "a.h5") if kind == "pairs" else list_hdf5(tmp_path / "a.h5", "blur", "gt")


def test_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.h5")
    for read in (PairFile, lambda path: list_hdf5(path, "blur", "gt")):
        with pytest.raises(ImageError, match="is a pipe"):
            read(tmp_path / "a.h5")


def test_a_heap_that_never_ends_is_refused(tmp_path):
    """An attribute's text in it: HDF5 2.0 searched forever, beyond any signal."""
    with PairFile.create(tmp_path / "a.h5", measurement_shape=SHAPE[1:], scene_shape=SHAPE[1:], attributes={"a": "b"}):
        pass
    with record(tmp_path / "b.h5", camera="c") as recorder:
        recorder.append(CameraFrame(array=np.zeros((4, 4, 1), np.uint8), bit_depth=8))
    for path, read in (("a.h5", PairFile), ("b.h5", lambda path: Replay(path).open())):
        content = bytearray((tmp_path / path).read_bytes())
        start = content.index(b"GCOL") + 16
        assert 0 < int.from_bytes(content[start + 8 : start + 16], "little") < 129  # bytes of text
        content[start + 8] = 129  # where the next object starts, there are zeros: one of size 0
        (tmp_path / path).write_bytes(content)
        with pytest.raises(ImageError, match=rf"The attributes of `.*{path}` cannot be read"):
            read(tmp_path / path)


def test_an_attribute_of_numbers_of_any_length_is_left_out(tmp_path):
    """HDF5 reads as many as the file says; damage made such an attribute of a text's, and a crash."""
    with PairFile.create(tmp_path / "a.h5", measurement_shape=(3, 3, 3), scene_shape=(3, 3, 3)) as file:
        file.append(*np.zeros((2, 3, 3, 3), np.float32))
    with h5py.File(tmp_path / "a.h5", "a") as file:
        numbers = np.empty((), h5py.vlen_dtype(np.uint8))
        numbers[()] = np.arange(3, dtype=np.uint8)
        kind = h5py.h5t.py_create(numbers.dtype, logical=True)
        h5py.h5a.create(file.id, b"numbers", kind, h5py.h5s.create(h5py.h5s.SCALAR)).write(numbers)
        file.attrs["name"] = "a text"
        file.attrs[b"\x80"] = 1
        attributes = read_attributes(tmp_path / "a.h5", file, "")
    assert attributes["name"] == "a text"
    assert not {"numbers", b"\x80"} & attributes.keys()
    assert len(PairFile(tmp_path / "a.h5")) == 1


@pytest.mark.parametrize("locking", [None, True, False])
def test_a_file_that_is_open_with_a_lock_is_read(tmp_path, locking):
    """In a notebook, say, where `h5py.File` looks at the pairs before `PairFile` reads them."""
    with PairFile.create(tmp_path / "pairs.h5", measurement_shape=SHAPE[1:], scene_shape=SHAPE[1:]) as file:
        file.append(torch.zeros(3, 3, 3), torch.ones(3, 3, 3))
    with h5py.File(tmp_path / "pairs.h5", locking=locking) as looked_at:
        assert PairFile(tmp_path / "pairs.h5")[0][1].min() == 1
        assert looked_at["scene"].shape[0] == 1
