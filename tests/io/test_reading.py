"""Files that are no files, too long, or not what they should be: refused at once, on one line that names them."""

import os
from pathlib import Path

import numpy as np
import pytest

from image_files import npy, put
from mwdn.errors import CheckpointError, ImageError, MwdnError, ParameterError
from mwdn.io.npy import read_array
from mwdn.io.reading import open_regular, read_bytes, read_json, read_text
from mwdn.io.toml import read_toml


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    """A FIFO hung forever, /dev/zero took 4 GB."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "link").symlink_to("pipe")
    faults = {
        "pipe": "a pipe",
        "link": "a pipe",
        "loop": "leads back to itself",
        "none": "does not exist",
        ".": "folder",
    }
    for name, fault in faults.items():
        with pytest.raises(CheckpointError, match=fault):
            open_regular(tmp_path / name, CheckpointError)
    with pytest.raises(ParameterError, match="`/dev/zero` must be a file, but is a device"):
        read_toml("/dev/zero")
    with pytest.raises(ImageError, match="null"):
        open_regular("a\0b")


def test_a_file_is_not_read_beyond_the_most_bytes(tmp_path: Path) -> None:
    path = put(tmp_path / "a", b"1234")
    assert read_bytes(path, most=4) == b"1234"
    os.truncate(path, 5 * 2**30)  # sparse: no disk is used
    with pytest.raises(ImageError, match=r"has 5,368,709,120 bytes; at most 4 are read"):
        read_bytes(path, most=4)


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe", b"[" * 10**5, b"9" * 5000, b'{"a":}\n\n\x1b[31m'])
def test_bad_json_is_named_on_one_line(tmp_path: Path, content: bytes) -> None:
    """203 of 320 damaged files of a benchmark ended in tracebacks that named no file."""
    path = put(tmp_path / "a\n\x1b.json", content)
    with pytest.raises(ParameterError) as caught:
        read_json(path)
    assert str(caught.value).isprintable()
    assert r"a\n\x1b.json" in str(caught.value)


@pytest.mark.parametrize("content", [b"a = [\n", b"a = '\xff'", b"a = " + b"[" * 10**5, b"a = " + b"9" * 5000])
def test_bad_toml_is_named_on_one_line(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(ParameterError, match=r"`.*a\.toml`") as caught:
        read_toml(put(tmp_path / "a.toml", content))
    assert len(str(caught.value).replace(str(tmp_path), "")) < 300


def test_text_keeps_what_it_holds(tmp_path: Path) -> None:
    assert read_text(put(tmp_path / "a.txt", "é\n".encode())) == "é\n"


def test_a_byte_order_mark_is_no_text(tmp_path: Path) -> None:
    """Editors on Windows write one: a camera file had an invalid statement in column 1."""
    assert read_toml(put(tmp_path / "a.toml", b'\xef\xbb\xbfpsf = "psf.png"\r\n')) == {"psf": "psf.png"}


def test_an_array_is_read_into_memory(tmp_path: Path) -> None:
    """A file that shrank while it was mapped ended the process by SIGBUS."""
    path = put(tmp_path / "a.npy", npy(np.arange(6.0).reshape(2, 3)))
    array = read_array(path)
    os.truncate(path, 130)
    np.testing.assert_array_equal(array, np.arange(6.0).reshape(2, 3))
    with pytest.raises(ImageError, match="needs 48 bytes of numbers and has 2"):
        read_array(path)
    for content in (npy(np.array([None]), allow_pickle=True), b"\x93NUMPY\1\0\xff\xff" + b"(" * 65535):
        with pytest.raises(MwdnError, match=r"`.*a\.npy` is not a"):
            read_array(put(path, content))
