"""The live picture on a real socket, with the simulated rig as camera."""

import io
import itertools
import json
import time
from contextlib import closing

import httpx2 as httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from mwdn.calibration import Calibration
from mwdn.capture import open_source
from mwdn.capture.folder import WatchedFolder
from mwdn.io.arrays import as_frame
from mwdn.io.images import write_frame
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.live import Live
from mwdn.preview.live_pictures import LivePictures
from mwdn.preview.live_recording import LiveRecording
from mwdn.preview.live_settings import LiveSettings
from mwdn.preview.server import make_server
from preview_server import LIMITS, SIDE


@pytest.fixture
def live(tmp_path, request):
    rig = open_source(f"rig,height={SIDE},width={SIDE},drop=0.2{getattr(request, 'param', '')}")
    live = Live(rig, Calibration(rig.psf), method="wiener", folder=tmp_path, device="cpu", retry_s=0.01)
    server = make_server(StoredCameras(LIMITS), LIMITS, device="cpu", live=live)
    server.start()
    yield server.url.replace("http", "ws") + "live", live
    server.stop()


@pytest.fixture
def viewer(live):
    with connect(live[0], open_timeout=60, close_timeout=0.1) as socket:  # it leaves with frames that it has not read
        yield socket


def parts(message):
    length = int.from_bytes(message[:4], "little")
    said = json.loads(message[4 : 4 + length])
    middle = 4 + length + said["measurement_bytes"]
    return said, message[4 + length : middle], message[middle:]


def until(socket, condition):
    """The first message that fulfils a condition."""
    while not condition(said := parts(socket.recv(timeout=60))[0]):
        pass
    return said


def test_viewers_share_frames_that_grow_newer(live):
    url, _ = live
    with connect(url, open_timeout=60) as first, connect(url, open_timeout=60) as second:
        numbers = []
        for _ in range(4):
            said, measurement, scene = parts(first.recv(timeout=60))
            assert measurement.startswith(b"\xff\xd8")
            assert scene.startswith(b"\xff\xd8")
            numbers.append(said["number"])
        assert numbers == sorted(set(numbers))
        assert said["latency_ms"] >= 0
        assert said["dropped"] <= said["number"]
        # The second one gets the same reconstructions: a frame that the first one has seen, or a later one.
        assert parts(second.recv(timeout=60))[0]["number"] >= 0
        first.send('{"exposure_s": 0.02}')
        until(second, lambda said: said.get("exposure_s") == 0.02)
        first.send('{"exposure_s": -1}')  # the camera refuses it, and goes on
        assert "exposure_s" in until(second, lambda said: said["refused"])["refused"]


def test_viewer_that_shows_nothing_gets_two_frames_at_most(live):
    url, _ = live
    with connect(url, open_timeout=60) as slow, connect(url, open_timeout=60) as fast:

        def frames_until_answer(number):
            slow.send(json.dumps({"clock": number}))
            count = 0
            while isinstance(message := slow.recv(timeout=60), bytes):
                count += 1
            answer = json.loads(message)
            assert answer["clock"] == number
            assert answer["server"] > 1e9
            return count

        slow.send('{"shown": true}')
        frames_until_answer(1)  # those before the message was read
        for _ in range(12):
            until(fast, lambda said: True)
        assert frames_until_answer(2) <= 2


def test_method_and_options_change(live, viewer):
    viewer.send('{"method": "admm", "options": {"iterations": 2}}')
    said = until(viewer, lambda said: said["method"] == "admm")
    assert said["options"] == {"iterations": 2}
    viewer.send('{"options": {"iterations": 0}}')  # refused by the solver: the settings before stay
    said = until(viewer, lambda said: said["refused"])
    assert "iterations" in said["refused"]
    viewer.send('{"gain": 1e9}')
    until(viewer, lambda said: "a `gain`" in said["refused"])
    viewer.send('{"method": "no-such"}')
    said = until(viewer, lambda said: "no-such" in said["refused"])
    assert "gain" not in said["refused"]  # a reason is gone with the next message
    assert (said["method"], said["options"]) == ("admm", {"iterations": 2})
    viewer.send('{"stops": 1.5, "white_balance": "grey-world", "room_light": true}')
    assert until(viewer, lambda said: said["room_light"])["refused"] == ""


def test_frame_of_the_room_is_subtracted_until_the_exposure_changes(live, viewer):
    _, served = live
    viewer.send('{"ambient": true}')
    until(viewer, lambda said: said["ambient"])
    picture = served.snapshot()
    assert picture.calibration.ambient is not None
    viewer.send('{"exposure_s": 0.005}')
    said = until(viewer, lambda said: not said["ambient"])
    assert "exposure" in said["refused"]


def test_snapshot_holds_the_raw_frame_and_its_picture(live, viewer):
    from mwdn import Reconstructor

    url, _ = live
    with httpx.Client(base_url=url.replace("ws", "http").removesuffix("/live"), timeout=60) as client:
        until(viewer, lambda said: True)
        job = client.post("/live/snapshots").json()
        assert job["report"]["exposure_s"] == 0.01
        assert job["report"]["bit_depth"] == 12
        raw = client.get(f"/jobs/{job['id']}/capture").content
        picture = np.load(io.BytesIO(client.get(f"/jobs/{job['id']}/picture?format=npy").content))
        cameras = client.get("/cameras").json()["cameras"]
        assert job["camera"] in [camera["name"] for camera in cameras]
        # The raw frame as a capture of the live camera gives the same picture.
        fields = {"camera": job["camera"], "method": "wiener", "trust": "false", "format": "npy"}
        again = client.post("/reconstruct", files={"capture": raw}, data=fields)
        np.testing.assert_array_equal(np.load(io.BytesIO(again.content)), picture)
    import cv2

    array = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert array.dtype == np.uint16
    calibration = Calibration(open_source(f"rig,height={SIDE},width={SIDE}").psf)
    scaled = as_frame(np.ascontiguousarray(array).astype(np.float32) / 4095)
    np.testing.assert_allclose(Reconstructor("wiener", calibration, device="cpu")(scaled), picture, atol=1e-5)


def test_recording_holds_raw_frames(live, viewer, tmp_path):
    _, served = live
    viewer.send('{"record": true}')
    said = until(viewer, lambda said: (said.get("recorded") or 0) >= 3)
    served.close()
    path = tmp_path / said["recording"]
    with open_source(f"replay:{path}") as replay:
        frames = [replay.read() for _ in range(said["recorded"])]
    assert frames[0].array.shape == (SIDE, SIDE, 3)
    assert frames[0].bit_depth == 12
    assert all(a.number < b.number for a, b in itertools.pairwise(frames))
    number = served.join(lambda: None)  # the next viewer starts no recording
    while served.newest is None or b'"recorded": null' not in served.newest:
        pass
    served.leave(number)


@pytest.mark.parametrize("live", [",disconnect_every=5"], indirect=True)
def test_camera_that_is_disconnected_is_opened_again(live, viewer):
    assert "disconnected" in until(viewer, lambda said: "error" in said)["error"]
    assert until(viewer, lambda said: "error" not in said)["number"] >= 0


def test_defect_is_told_and_does_not_end_the_live_picture(live, viewer, monkeypatch):
    _, served = live
    until(viewer, lambda said: "error" not in said)
    with monkeypatch.context() as broken:
        broken.setattr(served.pictures, "begin", lambda frame: 1 / 0)
        assert "ZeroDivisionError" in until(viewer, lambda said: "error" in said)["error"]
    until(viewer, lambda said: "error" not in said)


@pytest.mark.parametrize("live", [",read_noise=0"], indirect=True)
def test_frames_without_light_do_not_end_the_picture(live, viewer):
    _, served = live
    viewer.send('{"ambient": true}')
    until(viewer, lambda said: said["ambient"])
    served.camera._scale = 0.0  # a lens cap: less than the room's light
    assert "light" in until(viewer, lambda said: said["refused"])["refused"]
    served.camera._scale = 1.0
    until(viewer, lambda said: not said["refused"])


@pytest.mark.parametrize(
    "message",
    ["no JSON", "[]", '{"path": "/etc/passwd"}', '{"record": 1}', '{"gain": "x"}', f'{{"gain": {"9" * 500}}}'],
)
def test_wrong_messages_end_the_connection(live, message):
    from websockets.exceptions import ConnectionClosed

    url, _ = live
    with connect(url, open_timeout=60) as viewer:
        viewer.send(message)
        with pytest.raises(ConnectionClosed):
            until(viewer, lambda said: False)


def test_wish_made_while_another_is_refused_stays(monkeypatch):
    with open_source(f"rig,height={SIDE},width={SIDE}") as rig:
        frame, pictures = rig.read(), LivePictures(Calibration(rig.psf), LiveSettings("wiener"), "cpu")
    pictures.begin(frame)()
    prepare = LiveSettings.prepare

    def prepare_slowly(settings, *arguments):
        pictures.change({"method": "fista"})  # of another viewer
        return prepare(settings, *arguments)

    pictures.change({"options": {"regularisation": -1}})
    with monkeypatch.context() as patch:
        patch.setattr(LiveSettings, "prepare", prepare_slowly)
        assert pictures.begin(frame)().settings.method == "wiener"
    assert pictures.begin(frame)().settings.method == "fista"


def test_two_recordings_of_one_second_have_two_names(tmp_path, monkeypatch):
    """The second ended the live picture."""
    monkeypatch.setattr("mwdn.preview.live_recording.time.strftime", lambda *_: "recording-now")
    recording = LiveRecording(tmp_path, "rig")
    with open_source(f"rig,height={SIDE},width={SIDE}") as rig, closing(recording):
        for _ in range(3):
            recording.is_wanted = True
            recording.add(rig.read())
            recording.is_wanted = False
            assert recording.stop()
    assert sorted(path.name for path in tmp_path.glob("*.h5")) == [
        "recording-now-2.h5", "recording-now-3.h5", "recording-now.h5"
    ]  # fmt: skip


def test_a_folder_goes_on_after_frames_of_all_kinds_and_pauses(tmp_path):
    """An 8-bit frame, one of another size and a damaged one lost the good frames after them, and ended a recording."""
    with open_source(f"rig,height={SIDE},width={SIDE}") as rig:
        array, psf = (rig.read().array << 4).astype(np.uint16), rig.psf
    folder, said = tmp_path / "frames", []
    folder.mkdir()
    camera = WatchedFolder(folder, timeout_s=1.2, wait=lambda seconds: time.sleep(seconds / 10))
    live = Live(camera, Calibration(psf), method="wiener", folder=tmp_path, device="cpu", retry_s=0.01)
    viewer = live.join(lambda: said.append(parts(live.newest)[0]))

    def shown(condition):
        end = time.monotonic() + 20
        while not any(map(condition, said)):
            assert time.monotonic() < end, [each.get("refused", each) for each in said]
            time.sleep(0.02)
        said.clear()

    shown(lambda message: "no frame yet" in message.get("error", ""))
    live.control({"record": True})
    write_frame(folder / "0.png", array)
    shown(lambda message: message.get("recorded") == 1)
    time.sleep(0.3)  # longer than the time-out
    write_frame(folder / "1.png", (array >> 8).astype(np.uint8))
    shown(lambda message: message.get("number") == 1 and "delivers other frames" in message["refused"])
    live.control({"record": False})
    shown(lambda message: message.get("number") == 1 and message["recorded"] is None)  # though no frame comes
    write_frame(folder / "2.png", array[:-8])
    shown(lambda message: message.get("number") == 2 and "(40 x 48)" in message["refused"])
    (folder / "3.png").write_bytes((folder / "0.png").read_bytes()[:999])
    shown(lambda message: message.get("number") == 2 and "3.png" in message["refused"])
    write_frame(folder / "4.png", array)
    shown(lambda message: message.get("number") == 4 and not message["refused"])
    live.leave(viewer)
    live.close()
