"""The live picture on a real socket, with the simulated rig as camera."""

import itertools
import json

import pytest
from websockets.sync.client import connect

from mwdn.calibration import Calibration
from mwdn.capture import open_source
from mwdn.preview.cameras import Cameras
from mwdn.preview.live import Live
from mwdn.preview.server import make_server
from preview_server import LIMITS, SIDE


@pytest.fixture
def live(tmp_path):
    rig = open_source(f"rig,height={SIDE},width={SIDE},drop=0.2")
    live = Live(rig, Calibration(rig.psf), method="wiener", folder=tmp_path, device="cpu")
    server = make_server(Cameras(LIMITS), LIMITS, device="cpu", live=live)
    server.start()
    yield server.url.replace("http", "ws") + "live", live
    server.stop()


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


def test_recording_holds_raw_frames(live, tmp_path):
    url, served = live
    with connect(url, open_timeout=60) as viewer:
        viewer.send('{"record": true}')
        said = until(viewer, lambda said: (said.get("recorded") or 0) >= 3)
    served.close()
    (path,) = tmp_path.glob("recording-*.h5")
    with open_source(f"replay:{path}") as replay:
        frames = [replay.read() for _ in range(said["recorded"])]
    assert frames[0].array.shape == (SIDE, SIDE, 3)
    assert frames[0].bit_depth == 12
    assert all(a.number < b.number for a, b in itertools.pairwise(frames))


@pytest.mark.parametrize("message", ["no JSON", "[]", '{"path": "/etc/passwd"}', '{"record": 1}', '{"gain": "x"}'])
def test_wrong_messages_end_the_connection(live, message):
    from websockets.exceptions import ConnectionClosed

    url, _ = live
    with connect(url, open_timeout=60) as viewer:
        viewer.send(message)
        with pytest.raises(ConnectionClosed):
            until(viewer, lambda said: False)
