"""The page in a headless Chromium, used as a person uses it."""

import threading

import pytest

from browser import CHROMIUM, open_page
from mwdn.calibration import Calibration
from mwdn.capture import open_source
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.limits import Limits
from mwdn.preview.live import Live
from preview_server import LIMITS, SIDE

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt install chromium")


def test_dropped_files_become_a_picture(serve, psf, psf_file, capture, tmp_path):
    for name, data in (("psf.npy", psf_file), ("capture.npy", capture), ("wrong.png", b"no picture")):
        (tmp_path / name).write_bytes(data)
    server = serve(StoredCameras(LIMITS, None, {"camera": Calibration(psf)}))
    with open_page(server.url, tmp_path / "profile") as page:
        page.wait("document.querySelectorAll('#samples button').length === 3")
        page.run("document.getElementById('method').value = 'admm', document.getElementById('method').onchange()")
        page.run("document.getElementById('trust').checked = false")
        page.drop("#psf", tmp_path / "psf.npy")
        page.drop("#capture", tmp_path / "capture.npy")
        page.wait("document.getElementById('state').textContent.startsWith('admm: 48')")
        assert page.run("document.getElementById('scene').naturalWidth") == 48
        assert page.run("document.getElementById('measurement').naturalWidth") == 48

        # The divider moves by keys, too.
        page.run("document.getElementById('split').focus()")
        page.press("ArrowRight", 39)
        assert page.run("document.getElementById('stack').style.getPropertyValue('--split')") == "51%"

        # A slider makes another picture, of the capture that was chosen, whatever has been written over it.
        (tmp_path / "capture.npy").write_bytes(b"the next frame, not yet whole")
        before = page.run("document.getElementById('scene').src")
        page.run(
            "(slider => { slider.value = slider.max; slider.oninput(); })"
            "(document.getElementById('option-regularisation'))"
        )
        page.wait(f"document.getElementById('scene').src !== '{before}'")

        # A wrong file is named, and the page goes on.
        page.drop("#capture", tmp_path / "wrong.png")
        page.wait("document.getElementById('state').classList.contains('wrong')")
        assert "capture" in page.run("document.getElementById('state').textContent")
        assert page.run("document.getElementById('view').hidden")  # the picture was another file's
        (tmp_path / "capture.npy").write_bytes(capture)
        page.drop("#capture", tmp_path / "capture.npy")
        page.wait("document.getElementById('state').textContent.startsWith('admm: 48')")

        # The verdict on a PSF is not that of another one.
        page.run("document.getElementById('inspect').click()")
        page.wait("document.getElementById('headline').textContent")
        page.run("document.getElementById('orientation').value = 'rotate-180'")
        page.run("document.getElementById('orientation').onchange()")
        assert not page.run("document.getElementById('headline').textContent")

        page.size(390, 800)  # a phone's width: nothing is cut off
        assert page.run("document.documentElement.scrollWidth") <= 390
        named = page.run(
            "[...document.querySelectorAll('input, select, button')].every(e => "
            "(e.labels?.length || e.ariaLabel || e.textContent.trim()))"
        )
        assert named  # for screen readers
        assert not page.errors


def test_keyboard_alone_is_enough(serve, tmp_path):
    server = serve(StoredCameras(Limits()), limits=Limits())
    with open_page(server.url, tmp_path / "profile") as page:
        page.wait("document.querySelectorAll('#samples button').length === 3")
        page.run("document.getElementById('trust').checked = false")
        page.tab_to("e.textContent === 'cat'")
        page.press("Enter", 13, "\r")
        page.wait("document.getElementById('scene').naturalWidth > 0 && document.getElementById('cancel').hidden")
        page.tab_to("e.id === 'method'")
        assert page.run("getComputedStyle(document.activeElement).outlineStyle") != "none"  # one sees where one is
        page.press("a", 65, "a")  # a list takes the first entry of this letter
        page.wait("document.getElementById('state').textContent.startsWith('admm')")
        page.tab_to("e.id === 'split'")
        page.press("ArrowLeft", 37)
        assert page.run("document.getElementById('stack').style.getPropertyValue('--split')") == "49%"
        page.tab_to("e.id === 'save-png'")
        assert not page.errors


def test_the_token_leaves_the_address(serve, tmp_path):
    rig = open_source(f"rig,height={SIDE},width={SIDE},fps=20,prepared=2")
    live = Live(rig, Calibration(rig.psf), method="wiener", folder=tmp_path, device="cpu")
    server = serve(StoredCameras(LIMITS), live=live, token="secret")
    assert "token=secret" in server.url
    with open_page(server.url, tmp_path / "profile") as page:
        for _ in range(2):
            page.wait("document.querySelectorAll('#samples button').length === 3")
            assert page.run("location.pathname + location.search") == "/"
            assert page.run("document.cookie") == ""  # scripts cannot read it
            page.run("window.isOld = true")
            page.command("Page.reload")
            page.wait("!window.isOld && document.readyState === 'complete'")
        visited = page.command("Page.getNavigationHistory")["entries"]
        assert not [entry for entry in visited if "secret" in entry["url"]]
        page.wait("document.getElementById('live')?.hidden === false")
        page.run("document.getElementById('live-start').click()")
        page.wait("Number(document.getElementById('live-state').dataset.count) > 0")  # by a WebSocket
        page.run("document.getElementById('live-start').click()")
        assert not page.errors


def test_a_slider_returns_to_what_the_method_chooses(serve, tmp_path):
    server = serve(StoredCameras(Limits()), limits=Limits())
    value = "document.querySelector('label[for=option-regularisation] output').textContent"
    spoken = "document.getElementById('option-regularisation').ariaValueText"
    with open_page(server.url, tmp_path / "profile") as page:
        page.wait("document.querySelectorAll('#samples button').length === 3")
        page.run("document.getElementById('trust').checked = false")
        page.run("document.getElementById('method').value = 'wiener', document.getElementById('method').onchange()")
        assert (page.run(value), page.run(spoken)) == ("automatic", "automatic")
        page.tab_to("e.id === 'option-regularisation'")
        page.press("ArrowRight", 39)
        assert page.run(value) == page.run(spoken) != "automatic"
        page.tab_to("e.id === 'option-regularisation-reset'", most=1)
        assert page.run("document.activeElement.textContent") == "Reset to automatic"
        assert page.run("document.activeElement.ariaLabel") == "Reset to automatic: regularisation"
        page.press("Enter", 13, "\r")
        assert (page.run(value), page.run(spoken)) == ("automatic", "automatic")
        assert page.run("document.getElementById('option-regularisation-reset').hidden")
        assert page.run("document.activeElement.id") == "option-regularisation"  # the focus is not lost
        page.run("import('/static/sliders.js').then(sliders => { window.sent = sliders.readSliders(); })")
        assert page.run("window.sent") == {}  # the server chooses
        assert not page.errors


def test_a_capture_is_not_reconstructed_through_the_camera_of_the_samples(serve, psf_file, capture, tmp_path):
    for name, data in (("psf.npy", psf_file), ("capture.npy", capture)):
        (tmp_path / name).write_bytes(data)
    server = serve(StoredCameras(LIMITS))
    with open_page(server.url, tmp_path / "profile") as page:
        page.wait("document.querySelectorAll('#samples button').length === 3")
        assert page.run("document.getElementById('camera').value") == "sample"
        assert page.run("document.getElementById('format').disabled")  # it has its own
        assert page.run("document.getElementById('bin').matches(':disabled')")
        page.run("document.getElementById('trust').checked = false")
        page.drop("#capture", tmp_path / "capture.npy")
        page.wait("document.getElementById('state').textContent.startsWith('Drop a PSF')")
        page.drop("#psf", tmp_path / "psf.npy")
        page.wait("document.getElementById('state').textContent.startsWith('universal-small: 48')")
        assert not page.run("document.getElementById('bin').matches(':disabled')")
        for change in ("align", "room-light"):  # the pictures of all methods have been made without it
            page.run("document.getElementById('compare').click()")
            page.wait("document.querySelectorAll('#grid figure').length > 0")
            page.run(f"document.getElementById('{change}').onchange()")
            assert page.run("document.getElementById('grid-section').hidden")
        page.run("document.getElementById('compare').click()")
        page.wait("document.querySelectorAll('#grid figure').length > 0")
        page.drop("#capture", (tmp_path / "capture.npy").rename(tmp_path / "another.npy"))
        page.wait("document.getElementById('grid-section').hidden")
        page.run(
            "(files => { for (const name of 'ab') files.items.add(new File([name], name)); document.getElementById("
            "'capture').parentElement.dispatchEvent(new DragEvent('drop', { dataTransfer: files })); })"
            "(new DataTransfer())"
        )
        page.wait("document.getElementById('state').textContent.startsWith('2 files')")
        assert not page.errors


def test_verdicts_are_not_those_of_the_picture_before(serve, psf, capture, tmp_path, monkeypatch):
    from mwdn.inference.capture_pipeline import CapturePipeline

    (tmp_path / "capture.npy").write_bytes(capture)
    check, may_check = CapturePipeline.examine_scene, threading.Event()
    may_check.set()
    monkeypatch.setattr(CapturePipeline, "examine_scene", lambda *a, **b: may_check.wait(60) and check(*a, **b))
    server = serve(StoredCameras(LIMITS, None, {"camera": Calibration(psf)}))
    hidden = "document.getElementById('trust-section').hidden"
    with open_page(server.url, tmp_path / "profile") as page:
        page.wait("document.querySelectorAll('#samples button').length === 3")
        page.drop("#capture", tmp_path / "capture.npy")
        page.wait(f"!{hidden}")
        may_check.clear()
        page.run("document.getElementById('method').value = 'wiener', document.getElementById('method').onchange()")
        page.wait("document.getElementById('state').textContent.startsWith('Checking')")
        page.wait(hidden)
        may_check.set()
        page.wait(f"!{hidden}")


def test_hints_name_the_controls_of_the_page(serve, tmp_path):
    with open_page(serve().url, tmp_path / "profile") as page:
        page.wait("document.querySelectorAll('#samples button').length === 3")
        fields = 'calibration={"bin": 2, "psf_bin": 1}'
        for hint in ("--bin 2 --psf-bin 1", "bin=2, psf_bin=1", fields):
            words = page.run(f"import('/static/hints.js').then(hints => hints.pageWords('Try `{hint}`.'))")
            assert words == "Try “Bin”: 2, “Bin of the PSF”: 1."
        unknown = 'Keep `calibration={"upside_down": true}`, `{"x`.'
        assert page.run(f"import('/static/hints.js').then(hints => hints.pageWords('{unknown}'))") == unknown
        page.run(
            "import('/static/verdicts.js').then(verdicts => verdicts.showVerdicts({ summary: '', verdicts: ["
            "{ subject: 'psf', topic: 'psf-gamma', state: 'good', text: '' }, "
            "{ subject: 'capture', topic: 'exif', state: 'good', text: '' }] }))"
        )
        titles = page.run("[...document.querySelectorAll('#verdicts strong')].map(title => title.textContent.trim())")
        assert titles == ["PSF, gamma: good.", "Capture, EXIF orientation: good."]
        for control in ("bin", "psf-bin"):
            assert page.run(f"document.getElementById('{control}').labels[0].textContent").startswith("Bin")
