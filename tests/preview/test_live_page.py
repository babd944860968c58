"""The live picture in a headless Chromium: start, settings, snapshot, stop, and a connection that is lost."""

import json
import os
import re
import signal
import subprocess
import sys

import pytest

from browser import CHROMIUM, open_page
from mwdn.calibration import Calibration
from mwdn.capture import open_source
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.live import Live
from preview_server import LIMITS, SIDE

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt install chromium")
COUNT = "Number(document.getElementById('live-state').dataset.count ?? 0)"


def more_frames(page, number=3):
    """Wait until the page has painted some more."""
    page.wait(f"{COUNT} >= {page.run(COUNT) + number}")


def choose(page, id, value):
    page.run(f"(e => {{ e.value = {json.dumps(value)}; e.onchange(); }})(document.getElementById('{id}'))")


@pytest.mark.acceptance
def test_live_picture_is_started_used_and_stopped(serve, tmp_path):
    rig = open_source(f"rig,height={SIDE},width={SIDE},fps=20,prepared=4")
    live = Live(rig, Calibration(rig.psf), method="wiener", folder=tmp_path, device="cpu")
    server = serve(StoredCameras(LIMITS), live=live)
    with open_page(server.url, tmp_path / "profile") as page:
        page.wait("document.getElementById('live')?.hidden === false")
        page.run("document.getElementById('live-start').click()")
        more_frames(page)
        assert page.run("document.getElementById('live-scene').width") == SIDE
        assert 0 <= page.run("Number(document.getElementById('live-state').dataset.latency)") < 60_000
        # The page shows the method of the server, not that of its own list.
        page.wait("document.getElementById('method').value === 'wiener'")
        assert page.run("document.getElementById('room-light').value") == ""  # as the method does by default

        choose(page, "method", "admm")
        page.wait("document.getElementById('option-iterations')")
        page.run("(s => { s.value = 2; s.oninput(); })(document.getElementById('option-iterations'))")
        page.wait("!document.getElementById('live-state').classList.contains('wrong')")
        while live.pictures.settings.options != {"iterations": 2}:
            more_frames(page, 1)
        assert live.pictures.settings.method == "admm"

        # Options and look that another page has chosen: else the next change on this page would undo them.
        live.control({"options": {"iterations": 7}, "stops": 1.0, "white_balance": "grey-world"})
        page.wait("document.getElementById('option-iterations').value === '7'")
        assert page.run("document.getElementById('exposure-value').textContent") == "1.0"
        assert page.run("document.getElementById('balance').value") == "grey-world"
        choose(page, "balance", "none")
        while live.pictures.settings.look.white_balance is not None:
            more_frames(page, 1)
        assert live.pictures.settings.options == {"iterations": 7}

        choose(page, "live-exposure", "20")
        while rig.exposure_s != 0.02:
            more_frames(page, 1)
        page.run("document.getElementById('live-record').click()")
        page.wait("document.getElementById('live-state').textContent.includes('recorded')")
        page.run("document.getElementById('live-record').click()")
        page.wait("!document.getElementById('live-state').textContent.includes('recorded')")
        assert list(tmp_path.glob("recording-*.h5"))

        page.run("document.getElementById('live-snapshot').click()")
        page.wait("document.querySelector('#snapshots img')?.naturalWidth > 0")
        page.run("document.getElementById('trust').checked = false")
        page.run(
            "[...document.querySelectorAll('#snapshots button')].find(b => b.textContent === 'Work on it').click()"
        )
        page.wait("document.getElementById('state').textContent.startsWith('admm: 48')")  # and live has stopped
        assert page.run("document.getElementById('live-start').textContent") == "Start"
        assert page.run("document.getElementById('camera').value") == "live"
        page.wait("document.getElementById('scene').naturalWidth === 48")
        while live.viewers:
            pass
        assert not page.errors


@pytest.mark.acceptance
@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGTERM])
def test_page_comes_back_after_the_server(tmp_path, free_port, sign):
    """The server is killed and started again; the page reconnects by itself, with its settings."""
    line = [sys.executable, "-m", "mwdn", "preview", "--port", str(free_port), "--out", str(tmp_path / "out")]
    line += ["--live", f"rig,height={SIDE},width={SIDE},fps=20,prepared=4"]

    def start():
        server = subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        for said in server.stdout:
            if address := re.search(r"http://\S+/", said):
                return server, address[0]
        raise AssertionError("The server did not start.")

    server, url = start()
    try:
        with open_page(url, tmp_path / "profile") as page:
            page.wait("document.getElementById('live')?.hidden === false")
            choose(page, "method", "wiener")
            page.run("document.getElementById('live-start').click()")
            more_frames(page)
            choose(page, "balance", "grey-world")
            page.run("document.getElementById('live-record').click()")
            page.wait("document.getElementById('live-state').textContent.includes('recorded')")
            server.send_signal(sign)
            server.communicate(timeout=60)
            page.wait("document.getElementById('live-state').textContent.includes('connection is lost')")
            server, _ = start()
            more_frames(page)
            assert "wrong" not in page.run("document.getElementById('live-state').className")
            page.wait("document.getElementById('method').value === 'wiener'")
    finally:
        server.terminate()
        server.communicate(timeout=60)
    (recording,) = (tmp_path / "out" / "recordings").glob("*.h5")
    with open_source(f"replay:{recording}") as replay:  # what was recorded is there
        assert replay.read().array.shape == (SIDE, SIDE, 3)
