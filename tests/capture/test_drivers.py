"""Drivers of real cameras against simulations that their makers provide; a faked module for the Raspberry Pi."""

import os
import shutil
import signal
import subprocess
import sys
import time
from importlib import util
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mwdn.capture import aravis, open_source
from mwdn.capture.display import Display
from mwdn.capture.pixel_formats import choose_format, genicam_format, libcamera_format, unpack, v4l2_format
from mwdn.capture.recipe import CaptureRecipe, PicturesTable, SessionTable
from mwdn.capture.screen import Screen
from mwdn.capture.session import Session
from mwdn.capture.v4l2 import V4l2Camera
from mwdn.data import PairFile
from mwdn.errors import CameraError, MissingPackageError, ParameterError

FAKE_CAMERA = "arv-fake-gv-camera-0.8"


@pytest.fixture
def has_aravis():
    try:
        aravis._library()
    except (CameraError, MissingPackageError) as error:
        pytest.skip(str(error))


@pytest.fixture
def gige_camera(has_aravis):
    """Aravis's fake GigE Vision camera on the loopback interface: a process that speaks the protocol."""
    if shutil.which(FAKE_CAMERA) is None:
        pytest.skip(f"{FAKE_CAMERA} is not installed: apt install aravis-tools")
    serial = f"mwdn{os.getpid()}"
    process = subprocess.Popen([FAKE_CAMERA, "-i", "127.0.0.1", "-s", serial], stdout=subprocess.DEVNULL)
    yield serial
    process.terminate()
    process.wait()


@pytest.fixture
def pylon_emulation(monkeypatch):
    if util.find_spec("pypylon") is None:
        pytest.skip("pypylon is not installed: pip install 'mwdn[pypylon]'")
    monkeypatch.setenv("PYLON_CAMEMU", "1")


@pytest.fixture
def producer():
    """The simulated GenTL producer that comes with harvesters' genicam."""
    genicam = util.find_spec("genicam")
    if genicam is None or util.find_spec("harvesters") is None:
        pytest.skip("harvesters is not installed: pip install 'mwdn[harvesters]'")
    return next(Path(genicam.origin).parent.rglob("*.cti"))


def check_stream(camera, count=4, *, is_black=False):
    """Frames are new, numbered and not constant."""
    frames = [camera.read() for _ in range(count)]
    numbers = [frame.number for frame in frames]
    assert numbers == sorted(set(numbers))
    assert all((frame.array.std() == 0) == is_black for frame in frames)
    assert all(b.number - a.number == b.dropped + 1 for a, b in pairwise(frames))
    assert frames[-1].timestamp >= frames[0].timestamp > 1e9
    return frames


@pytest.mark.usefixtures("has_aravis")
def test_aravis_reads_its_own_simulation():
    with open_source("aravis:fake,pixel_format=Mono16") as camera:
        camera.configure(exposure_s=0.02, gain=3.0)
        frame = check_stream(camera)[-1]
        assert (frame.array.shape, frame.array.dtype, frame.bit_depth) == ((512, 512, 1), np.uint16, 16)
        assert (frame.exposure_s, frame.gain, frame.mosaic) == (0.02, 3.0, None)
        with pytest.raises(CameraError, match=r"exposure_s.*1e-05 to 10"):
            camera.configure(exposure_s=100.0)
    with pytest.raises(CameraError, match="not open"):
        camera.read()
    with open_source("aravis:fake") as camera:  # colour filters first
        assert camera.read().mosaic is not None
    with pytest.raises(CameraError, match="Mono8"), open_source("aravis:fake,pixel_format=Mono12Packed"):
        pass
    with pytest.raises(CameraError, match="arv-tool"), open_source("aravis:none-of-this-name"):
        pass


def test_aravis_reads_a_gige_vision_camera_and_notices_that_it_is_gone(gige_camera):
    camera = open_source("aravis:127.0.0.1,pixel_format=Mono8", timeout_s=30.0)
    with camera:
        assert check_stream(camera)[0].array.dtype == np.uint8


def test_pypylon_reads_baslers_emulation(pylon_emulation):
    with open_source("pypylon:Emulation,pixel_format=BayerRG12") as camera:
        camera.configure(exposure_s=0.02, gain=6.0)
        frame = check_stream(camera)[-1]
        assert (frame.array.dtype, frame.bit_depth, frame.mosaic) == (np.uint16, 12, "rggb")
        assert frame.array.max() < 4096
        assert (frame.exposure_s, frame.gain) == pytest.approx((0.02, 6.0), abs=0.01)
        with pytest.raises(CameraError, match="exposure_s"):
            camera.configure(exposure_s=1e6)
    with pytest.raises(CameraError, match="names 0 of"), open_source("pypylon:4711"):
        pass


def test_harvesters_reads_a_gentl_producer(producer):
    with open_source("harvesters:0", cti=str(producer)) as camera:
        frame = check_stream(camera, is_black=True)[-1]  # this producer draws in RGBa8 alone
        assert (frame.array.shape, frame.array.dtype, frame.bit_depth) == ((400, 400, 1), np.uint8, 8)
        with pytest.raises(CameraError, match=r"`exposure_s` \(0\.1\)"):
            camera.configure(exposure_s=0.1)
        with pytest.raises(KeyboardInterrupt):  # though harvesters sets a handler of its own
            signal.raise_signal(signal.SIGINT)
    with pytest.raises(CameraError, match="names 3 of 3"), open_source("harvesters:Viky", cti=str(producer)):
        pass
    with pytest.raises(CameraError, match="does not exist"), open_source("harvesters:0", cti="none.cti"):
        pass


@pytest.mark.usefixtures("producer")
def test_a_gentl_producer_must_be_named(monkeypatch):
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    with pytest.raises(CameraError, match="GENICAM_GENTL64_PATH"), open_source("harvesters:0"):
        pass


@pytest.mark.parametrize(
    ("source", "module", "extra"),
    [
        ("pypylon:first", "pypylon.pylon", "mwdn[pypylon]"),
        ("harvesters:0", "harvesters.core", "mwdn[harvesters]"),
        ("picamera2", "picamera2", "mwdn[picamera2]"),
        ("aravis:first", "gi", "gir1.2-aravis-0.8"),
    ],
)
def test_a_missing_driver_says_what_to_install(monkeypatch, source, module, extra):
    aravis._library.cache_clear()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingPackageError) as caught, open_source(source):
        pass
    assert extra in str(caught.value)
    aravis._library.cache_clear()


def test_v4l2_names_a_missing_device_and_packed_formats():
    with pytest.raises(CameraError, match="/dev/video99"), open_source("v4l2:99"):
        pass
    with pytest.raises(ParameterError, match="pRAA"):
        open_source("v4l2:0,fourcc=pRAA")


def test_v4l2_reads_until_the_device_is_silent(tmp_path):
    """A file of video in place of a device: the same calls of OpenCV."""
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for level in (40, 200):
        writer.write(np.full((48, 64, 3), (0, 0, level), np.uint8))  # BGR: red
    writer.release()
    with V4l2Camera(str(path), timeout_s=0.1) as camera:
        frames = [camera.read() for _ in range(2)]
        assert [frame.array.shape for frame in frames] == [(48, 64, 3)] * 2
        assert frames[1].array[..., 0].mean() == pytest.approx(200, abs=6)
        assert frames[1].array[..., 2].mean() == pytest.approx(0, abs=6)
        with pytest.raises(CameraError, match="no frame"):
            camera.read()
        with pytest.raises(CameraError, match="exposure_s"):
            camera.configure(exposure_s=0.01)


class Pi:
    """What `PiCamera` calls of picamera2: its format may differ from the one asked for."""

    delivered, stride, size = "SBGGR12", 64, (20, 6)
    sensor_modes = (
        {"unpacked": "SRGGB10", "bit_depth": 10, "size": (10, 6)},
        {"unpacked": "SRGGB12", "bit_depth": 12, "size": (20, 6)},
        {"unpacked": "SRGGB10", "bit_depth": 10, "size": (20, 6)},
    )

    def __init__(self, number):
        self.controls = {}
        self.camera_controls = {"ExposureTime": (100, 1_000_000, 20_000), "AnalogueGain": (1.0, 16.0, 1.0)}

    def create_video_configuration(self, raw, buffer_count):
        self.asked = raw
        return raw

    def configure(self, configuration):
        pass

    def camera_configuration(self):
        return {"raw": {"format": self.delivered, "size": self.size, "stride": self.stride}}

    def set_controls(self, controls):
        self.controls |= controls

    def start(self):
        pass

    def close(self):
        pass

    def capture_request(self, wait):
        rows = np.zeros((6, 32), np.uint16)
        rows[:, :20] = np.arange(120).reshape(6, 20)
        metadata = {"ExposureTime": self.controls.get("ExposureTime", 5), "AnalogueGain": 2.0}
        return SimpleNamespace(
            get_metadata=lambda: metadata, make_buffer=lambda _: rows.view(np.uint8).ravel(), release=lambda: None
        )


def test_picamera2_is_asked_for_unpacked_frames_and_believed_about_their_order(monkeypatch):
    """Against a faked module: the mapping of arguments, strides and the order of colours, not a camera."""
    made = []
    monkeypatch.setitem(sys.modules, "picamera2", SimpleNamespace(Picamera2=lambda n: made.append(Pi(n)) or made[-1]))
    with open_source("picamera2") as camera:
        assert made[0].asked == {"format": "SRGGB12", "size": (20, 6)}
        camera.configure(exposure_s=0.03, gain=2.0)
        assert made[0].controls == {"AeEnable": False, "AwbEnable": False, "ExposureTime": 30000, "AnalogueGain": 2.0}
        frame = camera.read()
        assert np.array_equal(frame.array[..., 0], np.arange(120).reshape(6, 20))
        assert (frame.mosaic, frame.bit_depth, frame.exposure_s, frame.gain) == ("bggr", 12, 0.03, 2.0)
        with pytest.raises(CameraError, match=r"0\.0001 to 1"):
            camera.configure(exposure_s=7.0)
    monkeypatch.setattr(Pi, "delivered", "SBGGR12_CSI2P")
    with pytest.raises(CameraError, match="packed"), open_source("picamera2"):
        pass
    with pytest.raises(CameraError, match="unpacked"), open_source("picamera2,pixel_format=SRGGB10_CSI2P"):
        pass


def test_names_of_formats():
    assert genicam_format("BayerGB12") == (12, "gbrg", 1)
    assert genicam_format("RGB8") == (8, None, 3)
    assert libcamera_format("SGRBG10") == (10, "grbg", 1)
    assert libcamera_format("R8") == (8, None, 1)
    assert v4l2_format("BA12") == (12, "grbg", 1)
    assert v4l2_format("BG10") == (10, "bggr", 1)
    assert v4l2_format("Y16") == (16, None, 1)
    for packed in ("Mono12Packed", "Mono12p", "BayerRG10p", "YUV422_8", "BGR8"):
        assert genicam_format(packed) is None
    for packed in ("SRGGB10_CSI2P", "RGGB16_PISP_COMP1", "YUV420"):
        assert libcamera_format(packed) is None
    offered = ["Mono8", "Mono12", "BayerRG8", "BayerRG10", "BayerRG12p", "RGB8"]
    assert choose_format(offered, "", "it")[0] == "BayerRG10"
    assert choose_format(offered, "Mono12", "it")[1].bit_depth == 12
    with pytest.raises(CameraError, match="only"):
        choose_format(["YUV422_8"], "", "it")


def test_a_buffer_has_a_stride_and_a_length():
    rows = np.arange(24, dtype="<u2").reshape(3, 8)
    format = genicam_format("Mono12")
    assert np.array_equal(unpack(rows.tobytes(), format, (3, 5), 16)[..., 0], rows[:, :5])
    colours = unpack(bytes(range(18)), genicam_format("RGB8"), (2, 3))
    assert colours[1, 0].tolist() == [9, 10, 11]
    with pytest.raises(CameraError, match="48 bytes"):
        unpack(b"123", format, (3, 8))


class Controlled(Display):
    """A display whose light Aravis's fake camera follows: the scale of its picture is 1 + log10(exposure / 10 ms)."""

    def __init__(self, camera):
        self.camera, self._screen = camera, Screen(width_px=96, height_px=54)

    @property
    def screen(self):
        return self._screen

    def show(self, picture):
        self.camera.configure(exposure_s=0.01 * 10 ** ((picture.mean() / 255) ** 2.2 - 1))
        return time.time()

    def close(self):
        pass


def test_a_gige_vision_camera_streams_into_a_session(gige_camera, tmp_path):
    (tmp_path / "photos").mkdir()
    for number in range(4):
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), np.full((20, 30, 3), 60 * number + 40, np.uint8))
    pictures = PicturesTable(size=(16, 24))
    recipe = CaptureRecipe(pictures=pictures, session=SessionTable(settle_s=0.0, patterns=("none",)), folder=tmp_path)
    with open_source("aravis:127.0.0.1,pixel_format=Mono8", timeout_s=30.0) as camera:
        session = Session(recipe, camera, Controlled(camera), tmp_path / "pairs.h5")
        assert session.run() == 4
    with PairFile(tmp_path / "pairs.h5") as pairs:
        assert pairs.measurement_shape == (512, 512, 1)
        light = [(float(scene.mean()), float(measurement.mean())) for measurement, scene in pairs]
    assert [measured for _, measured in sorted(light)] == sorted(measured for _, measured in light)
    assert len({round(measured, 2) for _, measured in light}) == 4
