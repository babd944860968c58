"""What the display of the simulated rig plays, and frames that are prepared."""

import cv2
import numpy as np
import pytest

from mwdn.capture import open_source
from mwdn.capture.playlist import PictureFolder, Video
from mwdn.errors import ImageError, ParameterError

SIZE = (27, 48)
COLOURS = {"a.png": (255, 0, 0), "b.png": (0, 255, 0), "c.png": (0, 0, 255)}


@pytest.fixture
def folder(tmp_path):
    for name, colour in COLOURS.items():
        cv2.imwrite(str(tmp_path / name), np.full((60, 60, 3), colour[::-1], np.uint8))
    (tmp_path / "notes.txt").write_text("no picture")
    return tmp_path


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (48, 27))
    for colour in COLOURS.values():
        writer.write(np.full((27, 48, 3), colour[::-1], np.uint8))
    writer.release()
    return path


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


def test_pictures_of_a_folder_take_turns(folder):
    clock = Clock()
    playlist = PictureFolder(folder, SIZE, 2.0, clock=clock)
    entries = []
    for clock.now in (100.0, 101.9, 102.1, 104.1, 106.1):
        entries.append(playlist.entry)
    assert entries == [0, 0, 1, 2, 0]
    assert playlist.read(1).shape == (*SIZE, 3)
    assert playlist.read(1)[0, 0].tolist() == [0, 255, 0]


def test_video_plays_at_its_rate_and_starts_again(video):
    clock = Clock()
    playlist = Video(video, SIZE, clock=clock)
    assert playlist.count == 3
    for clock.now, brightest in ((100.0, 0), (100.25, 2), (100.35, 0), (100.45, 1)):
        picture = playlist.read(playlist.entry)
        assert picture.shape == (*SIZE, 3)
        assert picture.mean((0, 1)).argmax() == brightest


def test_video_with_fewer_frames_than_its_header_says_starts_again(video):
    playlist = Video(video, SIZE)
    playlist.count = 9
    assert playlist.read(7).mean((0, 1)).argmax() == 0
    assert playlist.count == 3


def test_wrong_pictures_are_named(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "no-video.mp4").write_bytes(b"text")
    for error, name in ((ParameterError, "missing"), (ParameterError, "empty"), (ImageError, "no-video.mp4")):
        with pytest.raises(error, match=name):
            open_source(f"rig,pictures={tmp_path / name}")
    with pytest.raises(ParameterError, match="picture_s"):
        open_source(f"rig,pictures={tmp_path},picture_s=0")


def test_rig_plays_a_folder(folder):
    """Red, green and blue pictures give measurements of these colours."""
    clock = Clock()
    with open_source(f"rig,height=32,width=32,pictures={folder},picture_s=1,room_light=0") as rig:
        rig.playlist._clock = clock
        brightest = []
        for clock.now in (0.0, 1.0, 2.0, 3.0):
            brightest.append(int(rig.read().array.mean((0, 1)).argmax()))
    assert brightest == [0, 1, 2, 0]


def test_prepared_frames_come_again_with_new_numbers(folder):
    clock = Clock()
    with open_source(f"rig,height=32,width=32,prepared=2,pictures={folder},picture_s=1") as rig:
        rig.playlist._clock = clock
        clock.now = 0.0
        frames = [rig.read() for _ in range(4)]
        assert len({frame.number for frame in frames}) == 4
        shown = {frame.array.tobytes() for frame in frames}
        assert len(shown) == 2  # two exposures, with noise of their own
        clock.now = 1.0
        assert rig.read().array.tobytes() not in shown
        rig.configure(exposure_s=0.02)
        assert rig.read().array.mean() > frames[0].array.mean()
        clock.now = 3.0
        rig.configure(exposure_s=0.01)
        assert rig.read().array.tobytes() in shown


def test_prepared_frames_are_forgotten_with_another_picture():
    with open_source("rig,height=32,width=32,prepared=1") as rig:
        before = rig.read().array
        rig.show(np.full((270, 480, 3), 255, np.uint8))
        assert rig.read().array.mean() > before.mean()


def test_prepared_does_not_go_with_what_changes_each_frame():
    with pytest.raises(ParameterError, match="prepared"):
        open_source("rig,prepared=2,drift=0.1")
