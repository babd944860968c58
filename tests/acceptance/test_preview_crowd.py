"""50 viewers and 200 good and hostile uploads at once: every good one is answered correctly, and memory stays bounded.

The server runs in a process of its own. Set `MWDN_LIVE_SECONDS=600` for the long run of the live picture.
"""

import io
import json
import os
import re
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx2 as httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from mwdn import Reconstructor
from mwdn.preview.limits import Limits
from mwdn.preview.samples import sample_calibration, sample_capture, sample_png
from preview_server import hostile, npy

pytestmark = pytest.mark.acceptance
VIEWERS, UPLOADS = 50, 200
GROWTH_MB = (Limits().result_bytes + Limits().waiting_bytes) / 1e6
"""Largest growth: the results that are kept for download, and uploads that wait, at their documented limits."""

SECONDS = float(os.environ.get("MWDN_LIVE_SECONDS", "120"))


@contextmanager
def server(folder, live):
    """A server in a process of its own: the process and its address."""
    line = [sys.executable, "-m", "mwdn", "preview", "--port", "0", "--out", str(folder), "--device", "cpu"]
    process = subprocess.Popen([*line, "--live", live], stdout=subprocess.PIPE, text=True)
    try:
        said = iter(process.stdout)
        yield process, next(match[0] for line in said if (match := re.search(r"http://\S+/", line)))
    finally:
        process.terminate()
        process.communicate(timeout=60)


def resident_mb(process):
    """Memory of the server in megabytes."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1000


class Crowd:
    """Viewers of the live picture, a thread each; some do not read, some never say what they have shown."""

    def __init__(self, url, number):
        self.url, self.frames, self.ends = url.replace("http", "ws") + "live", [0] * number, threading.Event()
        self.threads = [threading.Thread(target=self._look, args=(index,)) for index in range(number)]

    def __enter__(self):
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self.ends.set()
        for thread in self.threads:
            thread.join(timeout=60)

    def _look(self, index):
        options = {"open_timeout": 60, "close_timeout": 1, "max_size": 2**24, "ping_interval": None}
        with suppress(ConnectionClosed), connect(self.url, **options) as socket:
            while not self.ends.is_set():
                with suppress(TimeoutError):
                    socket.recv(timeout=1)
                    self.frames[index] += 1
                    if index % 2:
                        socket.send('{"shown": true}')
                if index % 10 == 9:
                    self.ends.wait(1)  # a viewer that stalls


def test_fifty_viewers_and_two_hundred_uploads(tmp_path):
    name = "coffee"
    expected = Reconstructor("wiener", sample_calibration(), device="cpu")(sample_capture(name))
    good, bad = sample_png(name), [data for data, _ in hostile(npy(sample_capture(name))).values()]

    with server(tmp_path, "rig,height=96,width=96,fps=5,prepared=4") as (process, url), Crowd(url, VIEWERS) as crowd:
        deadline = time.monotonic() + 120
        while min(crowd.frames) < 1 and time.monotonic() < deadline:
            crowd.ends.wait(0.2)
        assert min(crowd.frames) >= 1

        def ask(number):
            capture = bad[number // 2 % len(bad)] if number % 2 else good
            fields = {"camera": "sample", "method": "wiener", "trust": "false", "format": "npy"}
            with httpx.Client(base_url=url, timeout=300) as client:
                return client.post("/reconstruct", files={"capture": capture}, data=fields)

        ask(0)
        before, largest, watched = resident_mb(process), [0.0], threading.Event()

        def watch():
            while not watched.wait(0.1):
                largest[0] = max(largest[0], resident_mb(process))

        watcher = threading.Thread(target=watch)
        watcher.start()
        seen, start = sum(crowd.frames), time.monotonic()
        with ThreadPoolExecutor(UPLOADS) as pool:
            answers = list(pool.map(ask, range(UPLOADS)))
        seconds = time.monotonic() - start
        watched.set()
        watcher.join()
        viewed = sum(crowd.frames) - seen
        after = resident_mb(process)
        health = httpx.get(f"{url}healthz").status_code
    figures = {
        "seconds": round(seconds, 1),
        "frames that viewers got meanwhile": viewed,
        "memory before, largest, after / MB": [round(before), round(largest[0]), round(after)],
    }
    print(json.dumps(figures))
    assert health == 200
    for answer in answers[::2]:
        assert answer.status_code == 200, answer.text
        np.testing.assert_allclose(np.load(io.BytesIO(answer.content)), expected, atol=1e-5)
    for answer in answers[1::2]:
        assert answer.status_code in (413, 422), answer.text
        assert answer.json()["error"]
    assert viewed > 0
    assert largest[0] - before < GROWTH_MB


def test_live_picture_does_not_grow(tmp_path):
    with server(tmp_path, "rig,height=320,width=320,fps=20,prepared=8") as (process, url), Crowd(url, 2) as crowd:
        deadline = time.monotonic() + 240
        while min(crowd.frames) < 600 and time.monotonic() < deadline:  # until then the allocator's pools still fill
            crowd.ends.wait(0.5)
        before, seen = resident_mb(process), sum(crowd.frames)
        crowd.ends.wait(SECONDS)
        after = resident_mb(process)
        print(json.dumps({"seconds": SECONDS, "frames": sum(crowd.frames) - seen, "MB": [round(before), round(after)]}))
    assert sum(crowd.frames) - seen > SECONDS / 2
    assert after - before < 20
