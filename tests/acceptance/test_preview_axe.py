"""axe-core finds no violation on the page: with a picture, methods and verdicts, and live; light, dark and narrow.

axe-core comes from npm, pinned, and is not kept. Screenshots go to results/acceptance/preview; look at them.
"""

import shutil
from pathlib import Path

import pytest

from browser import CHROMIUM, fetch_axe, open_page, violations
from mwdn.calibration import Calibration
from mwdn.capture import open_source
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.limits import Limits
from mwdn.preview.live import Live
from mwdn.preview.server import make_server

OUT = Path("results/acceptance/preview")

pytestmark = [
    pytest.mark.acceptance,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt install chromium"),
    pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm, for axe-core"),
]


@pytest.fixture(scope="module")
def axe(tmp_path_factory):
    return fetch_axe(tmp_path_factory.mktemp("axe"))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("preview")
    rig = open_source("rig,height=96,width=96,fps=10,prepared=4")
    live = Live(rig, Calibration(rig.psf), method="wiener", folder=folder, device="cpu")
    server = make_server(StoredCameras(Limits(), folder / "cameras"), live=live, device="cpu")
    server.start()
    try:
        with open_page(server.url, folder / "profile") as opened:
            opened.wait("document.querySelectorAll('#samples button').length === 3")
            yield opened
            assert not opened.errors
    finally:
        server.stop()


def show_picture(page):
    page.run("document.getElementById('trust').checked = true")
    page.run("document.querySelector('#samples button').click()")
    page.wait("document.getElementById('trust-section').hidden === false")
    page.run("document.getElementById('inspect').click()")
    page.wait("document.getElementById('findings').children.length > 0")
    page.run("document.querySelector('details').open = true")
    page.run("(s => { s.value = 'frame'; s.onchange(); })(document.getElementById('room-light'))")


def show_live(page):
    page.run("document.getElementById('live-start').click()")
    page.wait("document.getElementById('progress').hidden")  # the check of the picture before is given up
    page.wait("Number(document.getElementById('live-state').dataset.count) > 2")
    page.run("document.getElementById('live-snapshot').click()")
    page.wait("document.getElementById('snapshots').children.length === 1")


@pytest.mark.parametrize("show", [None, show_picture, show_live], ids=["empty", "picture", "live"])
def test_no_violation(page, axe, show):
    if show:
        show(page)
    name = show.__name__ if show else "empty"
    assert not violations(page, axe, OUT / name)
