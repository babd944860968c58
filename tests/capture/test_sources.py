"""Cameras from one string; recordings; folders with half-written files."""

import shutil

import h5py
import numpy as np
import pytest

from mwdn.capture import SOURCES, CameraFrame, CameraSource, open_source
from mwdn.capture.folder import WatchedFolder
from mwdn.capture.recording import record
from mwdn.capture.source import check_like
from mwdn.capture.sources import parse_source
from mwdn.errors import CameraError, ImageError, ParameterError, UnknownNameError
from mwdn.io.images import write_frame
from mwdn.runtime.streams import latest


def frame(number=0, shape=(6, 8, 1), **metadata):
    array = np.random.default_rng(number).integers(0, 4096, shape, np.uint16)
    values = {"bit_depth": 12, "mosaic": "rggb", "exposure_s": 0.5, "gain": 2.0, "timestamp": 100.0 + number}
    return CameraFrame(**{"array": array, "number": number, **values, **metadata})


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("rig", ("rig", "", {})),
        ("rig,seed=3,family=contours", ("rig", "", {"seed": 3, "family": "contours"})),
        ("v4l2:0", ("v4l2", "0", {})),
        ("folder:/a,b/c:d", ("folder", "/a,b/c:d", {})),
        ("folder:/a,b,bit_depth=12,mosaic=rggb", ("folder", "/a,b", {"bit_depth": 12, "mosaic": "rggb"})),
        ("replay:a=b.h5,loop=true", ("replay", "a=b.h5", {"loop": True})),
    ],
)
def test_a_string_names_a_camera(text, parts):
    assert parse_source(text) == parts


def test_wrong_strings_are_named(tmp_path):
    with pytest.raises(UnknownNameError, match="'rigg'"):
        open_source("rigg")
    with pytest.raises(CameraError, match="folder"):
        open_source("folder")
    with pytest.raises(CameraError, match="no address"):
        open_source("rig:3")
    with pytest.raises(UnknownNameError, match="sed"):
        open_source("rig,sed=3")
    with pytest.raises(ParameterError, match=r"`timeout_s` \(nan\)"):
        open_source("folder:here,timeout_s=nan")
    with pytest.raises(ParameterError, match="loop"):
        open_source("replay:a.h5,loop=maybe")
    with pytest.raises(CameraError, match="not a folder"), open_source(f"folder:{tmp_path / 'none'}"):
        pass


@pytest.mark.parametrize("close", [True, False])
def test_errors_of_a_drivers_library_are_camera_errors(close):
    with open_source("rig,height=32,width=48") as camera:
        with (
            pytest.raises(CameraError, match=r"was disconnected: no reply\. Check its cable\.$"),
            camera.as_camera_error("was disconnected", "Check its cable.", close=close),
        ):
            raise OSError("no reply")
        if not close:
            camera.read()
            with pytest.raises(CameraError, match=r"^it is silent$"), camera.as_camera_error("", "", close=False):
                raise CameraError("it is silent")
        with pytest.raises(CameraError, match="open"):
            camera.read()


def test_the_rig_is_a_camera_like_any_other():
    with open_source("rig,height=32,width=48,seed=5,bit_depth=8") as camera:
        assert isinstance(camera, CameraSource)
        camera.configure(exposure_s=1.0)
        assert camera.read().array.shape == (32, 48, 3)
        newest = latest(camera)
        assert next(newest).array.dtype == np.uint8
        newest.close()


def test_what_is_recorded_is_played_to_the_bit(tmp_path):
    path, frames = tmp_path / "frames.h5", [frame(number) for number in range(5)]
    with record(path, camera="v4l2:0", commit_every=2) as recorder:
        for each in frames:
            recorder.append(each)
        assert len(recorder) == 5
    with h5py.File(path) as file:
        assert file.attrs["camera"] == "v4l2:0"
    with open_source(f"replay:{path}") as camera:
        for each in frames:
            played = camera.read()
            assert np.array_equal(played.array, each.array)
            metadata = [{**vars(one), "array": None} for one in (played, each)]
            assert metadata[0] == metadata[1]
        with pytest.raises(CameraError, match="5 frames"):
            camera.read()
    with open_source(f"replay:{path},loop=true") as camera:
        assert [camera.read().number for _ in range(7)] == [0, 1, 2, 3, 4, 0, 1]


def test_the_order_of_bytes_is_the_computers_in_a_recording(tmp_path):
    path, array = tmp_path / "frames.h5", np.arange(12, dtype=np.uint16).reshape(3, 4, 1)
    for first, second in ((">u2", ">u2"), ("<u2", ">u2"), (">u2", "<u2")):
        with record(path) as recorder:
            for dtype in (first, second):
                recorder.append(CameraFrame(array=array.astype(dtype), bit_depth=12))
        with open_source(f"replay:{path}") as camera:
            for _ in range(2):
                np.testing.assert_array_equal(camera.read().array, array)
        path.unlink()


@pytest.mark.parametrize(
    "array", [np.zeros((3, 4), np.uint8), np.zeros((3, 4, 2), np.uint8), np.zeros((3, 4, 1), np.float32)]
)
def test_frames_that_could_not_be_played_are_not_recorded(array, tmp_path):
    with pytest.raises(CameraError, match="`array`"), record(tmp_path / "frames.h5") as recorder:
        recorder.append(CameraFrame(array=array, bit_depth=8))


def test_a_recording_waits_as_long_as_it_was_recorded(tmp_path):
    with record(tmp_path / "a.h5") as recorder:
        for number in range(3):
            recorder.append(frame(number, timestamp=50.0 + 100 * number))
    waits = []
    with open_source(f"replay:{tmp_path / 'a.h5'}", realtime=True, wait=waits.append) as camera:
        for _ in range(3):
            camera.read()
    assert waits == pytest.approx([0, 100, 200], abs=30)


def test_a_clock_that_was_set_during_a_recording_does_not_stop_it(tmp_path):
    """A Raspberry Pi sets its clock after the start: the picture stood still for 56 years. NaN ended it."""
    times = [50.0, 150.0, 1.8e9, 1.8e9 + 100, float("nan"), float("inf"), 1.8e9 + 200, 10.0, 110.0]
    with record(tmp_path / "a.h5") as recorder:
        for number, timestamp in enumerate(times):
            recorder.append(frame(number, timestamp=timestamp))
    waits = []
    with open_source(f"replay:{tmp_path / 'a.h5'}", realtime=True, wait=waits.append) as camera:
        assert [camera.read().number for _ in times] == [*range(9)]
    assert waits == pytest.approx([0, 100, 100, 200, 100], abs=30)


def test_a_recording_that_was_torn_keeps_its_committed_frames(tmp_path):
    path = tmp_path / "frames.h5"
    with record(path, commit_every=1) as recorder:
        for number in range(3):
            recorder.append(frame(number))
        shutil.copy(path, tmp_path / "copy.h5")
    with open_source(f"replay:{tmp_path / 'copy.h5'}") as camera:
        assert [camera.read().number for _ in range(3)] == [0, 1, 2]


def test_frames_of_another_size_are_refused_and_the_others_kept(tmp_path):
    path = tmp_path / "frames.h5"
    with pytest.raises(CameraError, match=r"8, 8"), record(path) as recorder:  # noqa: PT012
        recorder.append(frame(0))
        recorder.append(frame(1, shape=(8, 8, 1)))
    with open_source(f"replay:{path}") as camera:
        assert camera.read().number == 0
    with pytest.raises(CameraError, match="14 bits"):
        check_like(frame(0, bit_depth=14), frame(0), "it")


def test_files_without_frames_are_no_recording(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = np.zeros((2, 3, 4, 1), np.float32)
    with pytest.raises(ImageError, match="no raw frames"), open_source(f"replay:{tmp_path / 'a.h5'}"):
        pass


def numbered(folder, number):
    pixels = np.full((4, 5, 1), number, np.uint16)
    write_frame(folder / f"{number}.png", pixels)
    return folder / f"{number}.png"


def test_a_folder_gives_each_file_once_in_the_order_of_writing(tmp_path):
    for number in (2, 1):
        numbered(tmp_path, number)
    (tmp_path / "notes.txt").write_text("no frame")
    with open_source(f"folder:{tmp_path},bit_depth=12", timeout_s=0.2) as camera:
        frames = [camera.read() for _ in range(2)]
        assert [int(each.array[0, 0, 0]) for each in frames] == [2, 1]
        assert [each.number for each in frames] == [0, 1]
        assert frames[0].bit_depth == 12
        with pytest.raises(CameraError, match=r"0\.2 s"):
            camera.read()
        numbered(tmp_path, 3)
        assert int(camera.read().array[0, 0, 0]) == 3


def test_files_that_were_there_before_can_be_skipped(tmp_path):
    numbered(tmp_path, 1)
    with WatchedFolder(tmp_path, existing=False) as camera:
        numbered(tmp_path, 2)
        assert int(camera.read().array[0, 0, 0]) == 2


def test_a_short_timeout_suffices_for_a_file_that_is_there(tmp_path):
    write_frame(tmp_path / "a.png", np.zeros((3, 4, 1), np.uint8))
    with open_source(f"folder:{tmp_path},timeout_s=0.0", wait=lambda _: None) as camera:
        assert camera.read().array.shape == (3, 4, 1)
        with pytest.raises(CameraError, match="no frame"):
            camera.read()


def test_a_half_written_file_is_waited_for(tmp_path):
    whole = numbered(tmp_path, 7).read_bytes()
    part, waited = tmp_path / "7.png", []
    part.write_bytes(whole[: len(whole) // 2])

    def wait(seconds):
        waited.append(seconds)
        if len(waited) == 6:
            part.write_bytes(whole)

    with WatchedFolder(tmp_path, wait=wait) as camera:
        assert int(camera.read().array[0, 0, 0]) == 7
    assert len(waited) >= 7


def test_a_damaged_file_is_named_and_the_next_one_read(tmp_path):
    (tmp_path / "1.png").write_bytes(numbered(tmp_path, 1).read_bytes()[:50])
    with WatchedFolder(tmp_path, wait=lambda _: None) as camera:
        with pytest.raises(ImageError, match=r"1\.png"):
            camera.read()
        numbered(tmp_path, 2)
        assert int(camera.read().array[0, 0, 0]) == 2


def test_every_kind_of_camera_can_be_imported():
    for name, kind in SOURCES.items():
        assert kind.place.count(":") == 1, name
