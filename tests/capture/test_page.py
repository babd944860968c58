"""The display page: its protocol by a scripted client, and itself in headless Chromium."""

import json
import shutil
import subprocess
import threading
from contextlib import contextmanager
from http.client import HTTPConnection
from importlib import util
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from mwdn.capture.page import PageDisplay, checksum
from mwdn.errors import DisplayError, ParameterError

if util.find_spec("starlette") is None or util.find_spec("uvicorn") is None or util.find_spec("websockets") is None:
    pytest.skip("The page is not installed: pip install 'mwdn[page]'", allow_module_level=True)

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

CM = {"width_cm": 40.0, "height_cm": 30.0, "distance_cm": 20.0}
SIZE = 40, 60


def picture(seed=0, size=SIZE):
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8)


def address(display):
    return "ws" + display.url[4:].replace("/?", "/display?") + ("" if "?" in display.url else "display")


@contextmanager
def scripted(display, answer, size=SIZE):
    """A client that says its size, and answers each picture with ``answer(id, picture)``."""
    received = []

    def run():
        try:
            with connect(address(display)) as socket:
                received.append(json.loads(socket.recv()))
                state = {"width": size[1], "height": size[0], "visible": True}
                socket.send(json.dumps(state))
                for message in socket:
                    shown = cv2.imdecode(np.frombuffer(message[4:], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
                    reply = answer(int.from_bytes(message[:4], "little"), shown)
                    if reply is None:
                        return
                    socket.send(json.dumps({**state, **reply}))
        except ConnectionClosed:
            pass

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield received
    display.close()
    thread.join(10)


def honest(number, shown):
    return {"id": number, "sum": checksum(np.ascontiguousarray(shown))}


def test_a_picture_is_shown_once_the_page_has_confirmed_its_pixels():
    display = PageDisplay(**CM)
    seen = []
    with scripted(display, lambda number, shown: seen.append(shown.copy()) or honest(number, shown)) as received:
        screen = display.wait(10.0)
        assert (screen.width_px, screen.height_px, screen.width_cm) == (60, 40, 40.0)
        times = [display.show(picture(seed)) for seed in range(3)]
    assert times == sorted(times)
    assert received == [CM]
    assert all(np.array_equal(shown, picture(seed)) for seed, shown in enumerate(seen))


def test_a_page_that_shows_other_pixels_or_another_size_is_refused():
    display = PageDisplay(**CM)
    replies = [{"id": 1, "sum": 5}, {"id": 2, "error": "no memory"}, {"id": 3, "sum": 0, "width": 61}]
    with scripted(display, lambda number, shown: replies[number - 1]):
        display.wait(10.0)
        for message in ("other pixels", "no memory", "61 x 40"):
            with pytest.raises(DisplayError, match=message):
                display.show(picture())


def test_a_page_that_does_not_answer_is_named_and_a_new_one_gets_the_picture():
    display = PageDisplay(**CM, show_s=0.3)
    with pytest.raises(DisplayError, match="No page is open"):
        display.wait(0.01)
    with connect(address(display)) as silent:
        silent.send(json.dumps({"width": 60, "height": 40, "visible": False}))
        display.wait(10.0)
        with pytest.raises(DisplayError, match="hidden"):
            display.show(picture())
    display.show_s = 20.0
    with connect(address(display)) as leaving:
        leaving.send(json.dumps({"width": 60, "height": 40}))
        display.wait(10.0)
        leaving.close()
        with scripted(display, honest):  # the picture is sent again to the page that comes back
            display.show(picture(1))


def test_a_session_waits_until_the_page_has_its_final_size():
    with PageDisplay(**CM) as display, connect(address(display)) as page:
        page.send(json.dumps({"width": 60, "height": 40, "ready": False}))
        with pytest.raises(DisplayError, match="full-screen"):
            display.wait(0.2)
        page.send(json.dumps({"width": 90, "height": 70, "ready": True}))
        assert display.wait(10.0).width_px == 90


def test_only_the_newest_page_is_the_display():
    display = PageDisplay(**CM)
    with connect(address(display)) as first:
        first.recv()
        with scripted(display, honest):
            display.wait(10.0)
            display.show(picture())
            with pytest.raises(ConnectionClosed) as caught:
                first.recv(timeout=10)
            assert caught.value.rcvd.code == 4000


def status(display, path, headers=None):
    parts = urlsplit(display.url)
    connection = HTTPConnection(parts.hostname, parts.port, timeout=10)
    connection.request("GET", path, headers=headers or {})
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response, content


def test_the_page_is_served_with_security_headers_and_nothing_else_is():
    with PageDisplay(**CM) as display:
        response, content = status(display, "/")
        assert response.status == 200
        assert b"mwdn display" in content
        assert "default-src 'none'" in response.headers["Content-Security-Policy"]
        for path in ("/page.js", "/page.css"):
            assert status(display, path)[0].status == 200
        for path in ("/page.py", "/../page.py", "/static/page.js", "/%2e%2e/page.py"):
            assert status(display, path)[0].status == 404


def test_other_sites_and_wrong_tokens_are_refused():
    with pytest.raises(ParameterError, match="token"):
        PageDisplay(**CM, host="0.0.0.0")
    with PageDisplay(**CM) as display:
        for wrong in ({"origin": "http://evil.example"}, {"additional_headers": {"Host": "evil.example"}}):
            with pytest.raises((InvalidStatus, ValueError)), connect(address(display), **wrong):
                pass
    with PageDisplay(**CM, token="secret") as display:
        assert display.url.endswith("?token=secret")
        with connect(address(display)) as socket:
            socket.recv()
        with pytest.raises(InvalidStatus), connect(address(display).replace("secret", "guess")):
            pass


def test_messages_that_are_not_the_pages_close_the_connection():
    with PageDisplay(**CM) as display:
        for message in ("{", "[]", '{"width": 1}', '{"width": 0, "height": 5}', "x" * 5000):
            with connect(address(display)) as socket:
                socket.recv()
                socket.send(message)
                with pytest.raises(ConnectionClosed):
                    socket.recv(timeout=10)


def test_a_port_in_use_is_named():
    with PageDisplay(**CM) as display, pytest.raises(ParameterError, match="port"):
        PageDisplay(**CM, port=urlsplit(display.url).port)


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@contextmanager
def chromium(url, folder, *options):
    """Headless Chromium with a window of 800 x 600 pixels."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed: apt install chromium")
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run"]
    command += [f"--user-data-dir={folder}", "--window-size=800,600", "--disable-dev-shm-usage", *options, url]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(20)


def test_chromium_shows_each_pixel(tmp_path):
    with PageDisplay(**CM, show_s=60.0) as display, chromium(f"{display.url}#start", tmp_path):
        screen = display.wait(60.0)
        assert screen.width_px == 800
        for seed in range(3):
            display.show(picture(seed, (screen.height_px, screen.width_px)))  # checks the canvas's own pixels
        with pytest.raises(DisplayError, match="full-screen"):
            display.show(picture(0, (screen.height_px - 10, screen.width_px)))


def test_chromium_with_pixels_of_its_own_still_shows_each_pixel(tmp_path):
    with (
        PageDisplay(**CM, show_s=60.0, token="a b&c") as display,
        chromium(f"{display.url}#start", tmp_path, "--force-device-scale-factor=1.5"),
    ):
        screen = display.wait(60.0)
        assert screen.width_px == 1200
        display.show(picture(1, (screen.height_px, screen.width_px)))
