"""Growing files: whatever is on the disk after a crash, the last committed state comes back."""

import os
import shutil

import h5py
import numpy as np
import pytest

from full_disk import full_after
from mwdn.data import journal
from mwdn.data.journal import create_growing, journal_of, open_growing, recover
from mwdn.errors import ImageError

SHAPE = (5, 7, 3)


def row(number):
    return np.random.default_rng(number).integers(0, 65536, SHAPE, np.uint16)


def start(growing):
    growing.file.create_dataset("rows", (0, *SHAPE), np.uint16, maxshape=(None, *SHAPE), chunks=(1, *SHAPE))
    growing.commit()


def add(growing):
    data = growing.file["rows"]
    number = len(data)
    data.resize(number + 1, axis=0)
    data.id.write_direct_chunk((number, 0, 0, 0), row(number))


def rows(path):
    """Number of rows, after a check of each."""
    with h5py.File(path, "r") as file:
        for number, stored in enumerate(file["rows"]):
            assert np.array_equal(stored, row(number))
        return len(file["rows"])


def test_a_file_can_be_read_after_each_commit_and_grows_again_later(tmp_path):
    path = tmp_path / "a.h5"
    with create_growing(path) as growing:
        start(growing)
        for number in range(40):  # several nodes of HDF5's tree of chunks
            add(growing)
            growing.commit()
            assert rows(path) == number + 1
    with open_growing(path) as growing:
        add(growing)
        growing.commit()
    assert rows(path) == 41
    assert [file.name for file in tmp_path.iterdir() if not file.name.endswith(".lock")] == ["a.h5"]


def test_what_was_not_committed_is_gone(tmp_path):
    path = tmp_path / "a.h5"
    with create_growing(path) as growing:
        start(growing)
        add(growing)
        growing.commit()
        add(growing)
    size = path.stat().st_size
    assert rows(path) == 1
    with pytest.raises(ZeroDivisionError), open_growing(path) as growing:  # noqa: PT012
        add(growing)
        growing.file.flush()
        _ = 1 / 0
    assert (rows(path), path.stat().st_size) == (1, size)


def test_each_moment_of_a_commit_leaves_the_state_before_or_after(tmp_path, monkeypatch):
    """A crash at each flush of the disk: the disk then holds this, or (next test) anything between two of them."""
    path, copies, flush = tmp_path / "a.h5", [], os.fsync

    def snapshot(number):
        copies.append((tmp_path / str(len(copies)), committed))
        copies[-1][0].mkdir()
        for file in (path, journal_of(path)):
            if file.exists():
                shutil.copy(file, copies[-1][0])
        flush(number)

    committed = 0
    with create_growing(path) as growing:
        start(growing)
        monkeypatch.setattr(journal.os, "fsync", snapshot)
        for _ in range(3):
            add(growing)
            growing.commit()
            committed += 1
    monkeypatch.undo()
    assert len(copies) > 6
    for folder, before in copies:
        with open_growing(folder / "a.h5") as growing:
            count = len(growing.file["rows"])
            add(growing)
            growing.commit()
        assert count in (before, before + 1)
        assert rows(folder / "a.h5") == count + 1


@pytest.fixture
def torn(tmp_path, monkeypatch):
    """State before a commit, state after it, and the journal between them."""
    path, states = tmp_path / "a.h5", {}
    write_journal = journal._write_journal

    def keep(place, identity, disk):
        write_journal(place, identity, disk)
        states.update(before=path.read_bytes(), changes=list(disk.changes), journal=place.read_bytes())

    with create_growing(path) as growing:
        start(growing)
        add(growing)
        growing.commit()
        monkeypatch.setattr(journal, "_write_journal", keep)
        add(growing)
        growing.commit()
    monkeypatch.undo()
    return states


def put(tmp_path, file, log):
    path = tmp_path / "b.h5"
    path.write_bytes(file)
    journal_of(path).write_bytes(log)
    recover(path)
    assert not journal_of(path).exists()
    return rows(path)


def test_changes_that_were_applied_in_part_are_completed(tmp_path, torn):
    assert len(torn["changes"]) > 1
    for done in range(len(torn["changes"]) + 1):
        content = bytearray(torn["before"])
        for place, data in torn["changes"][:done]:
            half = data if place % 2 else data[: len(data) // 2]  # a torn sector, too
            content[place : place + len(half)] = half
        assert put(tmp_path, content, torn["journal"]) == 2


def test_a_journal_that_was_cut_off_or_is_damaged_does_not_count(tmp_path, torn):
    for length in (0, 3, 40, len(torn["journal"]) // 2, len(torn["journal"]) - 1):
        assert put(tmp_path, torn["before"], torn["journal"][:length]) == 1
    damaged = bytearray(torn["journal"])
    damaged[60] ^= 1
    assert put(tmp_path, torn["before"], damaged) == 1


def test_the_journal_of_another_file_is_not_applied(tmp_path, torn):
    path = tmp_path / "other.h5"
    with create_growing(path) as growing:
        start(growing)
    journal_of(path).write_bytes(torn["journal"])
    with pytest.raises(ImageError, match="another file"):
        recover(path)
    assert rows(path) == 0


def test_a_full_disk_loses_nothing_that_was_committed(tmp_path):
    path = tmp_path / "a.h5"
    with create_growing(path) as growing:
        start(growing)
        for _ in range(3):
            add(growing)
            growing.commit()
    with full_after(path.stat().st_size + 100), open_growing(path) as growing:
        add(growing)
        with pytest.raises(OSError, match="large"):
            growing.commit()
    assert rows(path) == 3
    with open_growing(path) as growing:
        add(growing)
        growing.commit()
    assert rows(path) == 4


def test_two_processes_cannot_write_one_file(tmp_path):
    with create_growing(tmp_path / "a.h5") as growing:
        start(growing)
        with pytest.raises(ImageError, match="Another process"), open_growing(tmp_path / "a.h5"):
            pass
    with pytest.raises(ImageError, match="exists"), create_growing(tmp_path / "a.h5"):
        pass


def test_other_files_cannot_grow(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rows"] = np.zeros(3)
    with pytest.raises(ImageError, match="cannot grow"), open_growing(tmp_path / "a.h5"):
        pass
    (tmp_path / "b.h5").write_bytes(b"nothing")
    with pytest.raises(ImageError, match=r"b\.h5"), open_growing(tmp_path / "b.h5"):
        pass
