"""The frame of a picture: taken after the display has settled, whatever the camera's queue, clock and files."""

import time
from collections.abc import Iterator

import numpy as np
import pytest

from mwdn.capture.grabber import Grabber
from mwdn.capture.recipe import CameraTable
from mwdn.capture.source import CameraFrame, CameraSource
from mwdn.errors import CameraError, ImageError


class Camera(CameraSource):
    """Delivers a frame for each number: its age in seconds by this computer's clock; or raises an error."""

    def __init__(self, ages: Iterator[float | Exception]) -> None:
        super().__init__("fake", timeout_s=0.05)
        self.ages, self.number, self.opened = ages, -1, 0

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        pass

    def read(self) -> CameraFrame:
        age = next(self.ages)
        if isinstance(age, Exception):
            raise age
        self.number += 1
        frame = np.zeros((4, 4, 1), np.uint8)
        return CameraFrame(array=frame, bit_depth=8, timestamp=time.time() - age, number=self.number)


def endless(age: float) -> Iterator[float]:
    while True:
        time.sleep(0.005)
        yield age


def grabber(ages: Iterator[float | Exception], attempts: int = 0) -> Grabber:
    return Grabber(Camera(ages), CameraTable(attempts=attempts), 0, lambda _: None)


def test_queued_frames_of_an_unsettled_display_are_passed_over():
    """Pictures were paired with the frame of the one before: queued frames were taken after the wait."""
    shown = time.time() - 1.5  # waited for 1 s, and then something else
    queue = iter([1.4, 1.0, 0.6, 0.4, 0.0])
    assert grabber(queue).after(shown, settle_s=1.0).number == 3


def test_the_exposure_begins_after_the_display_has_settled():
    camera = grabber(iter([0.3, 0.1]))
    shown = time.time() - 0.5
    assert camera.after(shown, settle_s=0.3).number == 1


def test_a_clock_that_is_ahead_is_named():
    with pytest.raises(CameraError, match=r"fake has a time (59|60)\.\d s ahead of this computer's\. Set its clock"):
        grabber(endless(-60.0)).after(time.time())


def test_a_clock_that_is_behind_does_not_wait_forever():
    with pytest.raises(CameraError, match=r"newest frame of fake is 60\.\d s old.*Set its clock.*`timeout_s`"):
        grabber(endless(60.0)).after(time.time())


def test_a_damaged_frame_is_passed_over():
    damaged = ImageError("`f.png` is cut off.")
    with pytest.warns(UserWarning, match="is cut off. The next frame is taken") as warned:
        assert grabber(iter([damaged, damaged, 0.0]), attempts=2).after(time.time() - 1).number == 0
    assert len(warned) == 2
    with pytest.warns(UserWarning, match="The next frame"), pytest.raises(ImageError, match="cut off"):
        grabber(iter([damaged, damaged, 0.0]), attempts=1).after(time.time() - 1)


def test_a_camera_that_fails_is_opened_again():
    camera = grabber(iter([CameraError("Gone."), 0.0]), attempts=1)
    with pytest.warns(UserWarning, match="Gone. Opened again, attempt 1"):
        assert camera.after(time.time() - 1).number == 0
    assert camera.camera.opened == 1


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("wrong", [{"timeout_s": -1.0}, {"attempts": -1}, {"exposure_s": -0.1}])
def test_wrong_settings_of_a_camera_are_refused(wrong):
    with pytest.raises(Exception, match=rf"`{next(iter(wrong))}`"):
        CameraTable(**wrong)
