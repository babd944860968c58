"""A file is written completely or not at all."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from image_files import put
from mwdn.errors import ImageError, ParameterError
from mwdn.io.files import atomic, check_folder, refuse_foreign, refuse_overwrite
from mwdn.io.images import read_frame, write_linear, write_picture


def test_a_writer_that_fails_half_way_leaves_the_old_file(tmp_path: Path) -> None:
    path = put(tmp_path / "a.bin", b"old")
    with pytest.raises(RuntimeError, match="half-way"), atomic(path) as temporary:  # noqa: PT012
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".bin"
        temporary.write_bytes(b"ne")
        raise RuntimeError("half-way")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_writer_that_succeeds_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "a.bin"
    for content in (b"old", b"new"):
        with atomic(path) as temporary:
            temporary.write_bytes(content)
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    """It may lead to an input, or to a capture in another folder."""
    target, link = put(tmp_path / "target.bin", b"old"), tmp_path / "link.bin"
    link.symlink_to(target)
    with pytest.raises(OSError, match=r"it is a symbolic link to `.*target\.bin`"), atomic(link) as temporary:
        temporary.write_bytes(b"new")
    assert target.read_bytes() == b"old"
    with pytest.raises(ParameterError, match=r"link\.bin` cannot be written: it is a symbolic link"):
        refuse_overwrite(link)


@pytest.mark.skipif(sys.platform != "linux", reason="no number of the computer's start")
def test_a_killed_process_leaves_nothing_for_long(tmp_path: Path) -> None:
    """Hidden files of killed runs piled up. Those of running processes and of other computers must stay."""
    killed = (
        "import os; from pathlib import Path; from mwdn.io.files import atomic\nwith atomic(Path('b.bin')): os.kill("
    )
    subprocess.run([sys.executable, "-c", killed + "os.getpid(), 9)"], cwd=tmp_path, check=False)
    (left,) = tmp_path.iterdir()
    _, computer, process, token = left.name.split("-")
    kept = [f".mwdn-{computer}-{os.getppid()}-{token}", f".mwdn-00000000-{process}-{token}", ".mwdn-notes"]
    for name in kept:
        put(tmp_path / name, b"")
    with atomic(tmp_path / "a.bin"):
        assert not left.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*kept, "a.bin"])


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="not a regular file"), atomic(tmp_path / "pipe"):
        pass
    assert (tmp_path / "pipe").is_fifo()


def test_files_of_others_are_not_replaced(tmp_path: Path) -> None:
    refuse_foreign(tmp_path, ("index.html", "sheet.png"), b"mwdn demo")
    sheet = put(tmp_path / "sheet.png", b"holiday")
    with pytest.raises(ParameterError, match=r"sheet\.png` was not written by this command and would be lost"):
        refuse_foreign(tmp_path, ("index.html", "sheet.png"), b"mwdn demo")
    page = put(tmp_path / "index.html", b"<title>mwdn demo</title>")
    refuse_foreign(tmp_path, ("index.html", "sheet.png"), b"mwdn demo")
    sheet.unlink()
    put(page, b"my page")
    os.truncate(page, 2**40)  # sparse; was read whole
    with pytest.raises(ParameterError, match=r"index\.html` was not written by this command"):
        refuse_foreign(tmp_path, ("index.html", "sheet.png"), b"mwdn demo")


@pytest.mark.parametrize(
    ("write", "name"), [(write_picture, "a.png"), (write_linear, "a.npy"), (write_linear, "a.tif")]
)
def test_a_full_disk_is_an_image_error_and_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[..., None], name: str
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    path = put(tmp_path / name, b"old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ImageError, match=rf"{name}` cannot be written: No space left on device"):
        write(path, torch.rand(3, 4, 4))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_where_a_folder_should_be(tmp_path: Path) -> None:
    put(tmp_path / "taken", b"")
    with pytest.raises(ImageError, match="cannot be written"):
        write_picture(tmp_path / "taken" / "a.png", torch.rand(3, 4, 4))


@pytest.mark.skipif(sys.platform == "win32", reason="other limits of names")
def test_a_name_that_is_too_long_asks_for_another_name(tmp_path: Path) -> None:
    """It asked for another folder, where the name is as long."""
    with pytest.raises(ImageError, match="shorter name"):
        write_picture(tmp_path / f"{252 * 'a'}.png", torch.zeros(1, 3, 2, 2))


def test_a_folder_where_the_file_should_be(tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    with pytest.raises(ImageError, match="cannot be written: Is a directory"):
        write_picture(tmp_path / "a.png", torch.rand(3, 4, 4))
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="nothing is read-only to root")
def test_a_read_only_folder(tmp_path: Path) -> None:
    path = put(tmp_path / "a.png", b"secret")
    path.chmod(0)
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(ImageError, match="cannot be written: Permission denied"):
            write_picture(tmp_path / "b.png", torch.rand(3, 4, 4))
        with pytest.raises(ImageError, match="cannot be read: Permission denied"):
            read_frame(path)
    finally:
        tmp_path.chmod(0o700)


def test_the_check_of_a_folder_leaves_nothing(tmp_path: Path) -> None:
    check_folder(tmp_path / "new" / "deep")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    with pytest.raises(ParameterError, match="file/new"):
        check_folder(tmp_path / "file" / "new")
