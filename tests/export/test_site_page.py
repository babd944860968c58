"""The static page in a headless Chromium, from the disk and from a static host, used as a person uses it."""

import base64
import functools
import http.server
import io
import shutil
import threading
from contextlib import contextmanager
from pathlib import Path

import cv2
import jaxtyping
import numpy as np
import pytest
import torch

from browser import CHROMIUM, fetch_axe, open_page, violations
from mwdn import Calibration, Camera, Reconstructor, read_frame, to_display, write_picture
from mwdn.calibration.white_balance import apply_white_balance
from mwdn.cli.app import main
from mwdn.data.random import seeded
from mwdn.errors import ExportError
from mwdn.export.exporter import agreement
from mwdn.export.web_runtime import read_runtime
from mwdn.io.images import write_frame
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera

pytest.importorskip("onnxruntime", reason="The extra is missing: pip install 'mwdn[export]'")
pytestmark = [
    pytest.mark.acceptance,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt install chromium"),
]

SIZE = 96, 128
STATE = "document.getElementById('state')"
AT_LEAST = 50  # dB against the package


def psf_frame(seed, bits):
    psf = sample_camera(seed, SIZE, family="contours")[0].movedim(0, -1)
    return (psf / psf.max() * 0.9 * 2**bits + 0.02 * 2**bits).numpy().astype(np.uint8 if bits == 8 else np.uint16)


def write_capture(path, calibration, picture, maximum=65535, peak=0.8):
    light = Camera(calibration.psf).simulate(dark_scene(picture, SIZE, 60), generator=seeded(1))
    light = light * (peak / light.max())
    write_frame(path, (light.clamp(0, 1) * maximum).round()[0].movedim(0, -1).numpy().astype(np.uint16))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A site for a camera of 12 bits, files of that camera and of another one."""
    try:
        read_runtime()
    except ExportError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("site")
    write_frame(folder / "psf.png", psf_frame(0, 12))
    write_frame(folder / "other.png", psf_frame(1, 8))
    write_frame(folder / "dark.png", np.random.default_rng(0).integers(0, 300, (*SIZE, 3), np.uint16))
    own = Calibration.from_file(folder / "psf.png", bit_depth=12, dark=folder / "dark.png")
    other = Calibration.from_file(folder / "other.png", psf_orientation="rotate-180")
    write_capture(folder / "capture.png", own, "coffee", maximum=4095)
    write_capture(folder / "bright.png", own, "coffee", maximum=4095, peak=2.0)
    hot = read_frame(folder / "capture.png")
    hot[[10, 50, 51, 80], [20, 60, 60, 127], 1] += 1500
    write_frame(folder / "hot.png", hot)
    write_capture(folder / "of-the-other.png", other, "cat")
    for name in ("other.png", "of-the-other.png"):  # of a sensor with pixels of half the size
        write_frame(folder / f"fine-{name}", read_frame(folder / name).repeat(2, 0).repeat(2, 1))
    (folder / "wrong.png").write_bytes((folder / "capture.png").read_bytes()[:-1000])
    (folder / "photo.jpg").write_bytes(cv2.imencode(".jpg", np.zeros((96, 128, 3), np.uint8))[1].tobytes())
    write_frame(folder / "small.png", np.zeros((64, 64, 3), np.uint8))
    write_site(folder / "site", folder / "psf.png", "--bit-depth", "12", "--dark", folder / "dark.png")
    return folder, own, other


def write_site(out, *camera):
    jaxtyping.config.update("jaxtyping_disable", True)  # torch traces with sizes that are no numbers
    with pytest.raises(SystemExit) as ended:
        main(["export", "--web", *map(str, camera), "-o", str(out)])
    jaxtyping.config.update("jaxtyping_disable", False)
    assert ended.value.code == 0


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@contextmanager
def static_host(folder):
    """Python's own file server on the loopback interface."""
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/index.html"
        finally:
            server.shutdown()
            thread.join()


def said(page):
    return page.run(f"{STATE}.textContent")


def wait_for(page, name):
    text = f"{STATE}.textContent"
    page.wait(f"{text}.startsWith('{name}: ') || {STATE}.classList.contains('wrong') && {text}.startsWith('{name} ')")
    assert said(page).startswith(f"{name}: 128 × 96 pixels in "), said(page)
    assert said(page).endswith("by WebAssembly, on this computer."), said(page)


def saved(page, button):
    """What a download holds."""
    page.run(
        "window.made ??= []; window.make ??= URL.createObjectURL; "
        "URL.createObjectURL = blob => { window.made.push(blob); return window.make(blob); }"
    )
    count = page.run("window.made.length")
    page.run(f"document.getElementById('{button}').click()")
    page.wait(f"window.made.length > {count}")
    data = page.run(
        "new Promise(done => { const reader = new FileReader(); reader.onload = () => done(reader.result); "
        "reader.readAsDataURL(window.made.at(-1)); })"
    )
    return base64.b64decode(data.split(",")[1])


def check_scene(page, calibration, capture):
    """The page's float picture against the package's for the same file."""
    scene = np.load(io.BytesIO(saved(page, "save-npy")))
    reconstruct = Reconstructor("universal-small", calibration, device="cpu", precision="exact")
    expected = reconstruct(calibration.correct(calibration.frames.read(capture)))
    reached = agreement(torch.from_numpy(scene).movedim(-1, 0)[None], expected)
    print(f"{capture.name}: {reached:.1f} dB")
    assert reached > AT_LEAST
    return expected


def check_files(page, folder, own, other):
    """Captures of this camera and of another one, and files that are none."""
    for name in ("capture.png", "bright.png", "hot.png"):  # the second is saturated, the third has hot pixels
        page.drop("#capture", folder / name)
        wait_for(page, name)
        check_scene(page, own, folder / name)
    page.drop("#capture", folder / "capture.png")
    wait_for(page, "capture.png")

    page.drop("#psf", folder / "other.png")
    page.wait(f"{STATE}.textContent.startsWith('capture.png: ') || {STATE}.classList.contains('wrong')")
    page.run("(o => { o.value = 'rotate-180'; o.onchange(); })(document.getElementById('orientation'))")
    page.drop("#capture", folder / "of-the-other.png", folder / "capture.png")
    wait_for(page, "of-the-other.png")
    expected = check_scene(page, other, folder / "of-the-other.png")
    assert page.run("document.querySelectorAll('#captures button').length") == 2
    page.drop("#psf", folder / "fine-other.png")
    page.wait(f"{STATE}.classList.contains('wrong')")
    # The PSF is binned, and so are captures.
    assert said(page).startswith("of-the-other.png has 96 x 128 pixels, 48 x 64 as a measurement")
    page.drop("#capture", folder / "fine-of-the-other.png")
    wait_for(page, "fine-of-the-other.png")
    fine = Calibration.from_file(folder / "fine-other.png", bin=2, psf_orientation="rotate-180")
    check_scene(page, fine, folder / "fine-of-the-other.png")

    # Pictures for people are the package's, within rounding.
    for button, bits in (("save-png", 8), ("save-png16", 16)):
        (folder / "saved.png").write_bytes(saved(page, button))
        write_picture(folder / "expected.png", to_display(expected), bits=bits)
        difference = read_frame(folder / "saved.png").astype(int) - read_frame(folder / "expected.png").astype(int)
        assert abs(difference).max() <= (1 if bits == 8 else 64)

    for name, words in (
        ("wrong.png", "damaged or cut off"),
        ("photo.jpg", "neither PNG nor NPY"),
        ("small.png", "64 x 64"),
    ):
        page.drop("#capture", folder / name)
        page.wait(f"{STATE}.classList.contains('wrong') && {STATE}.textContent.startsWith('{name} ')")
        assert words in said(page)
    page.drop("#psf", folder / "small.png")
    page.wait(f"{STATE}.textContent.includes('This page reconstructs 96 x 128')")


def check_controls(page):
    page.run("document.querySelector('#samples button').click()")
    wait_for(page, "astronaut")
    # The linear numbers have the white balance of the picture, as from `mwdn reconstruct`.
    plain = np.load(io.BytesIO(saved(page, "save-npy")))
    page.run("(b => { b.value = 'grey-world'; b.onchange(); })(document.getElementById('balance'))")
    balanced = torch.from_numpy(np.load(io.BytesIO(saved(page, "save-npy")))).movedim(-1, 0)[None]
    expected = apply_white_balance(torch.from_numpy(plain).movedim(-1, 0)[None], "grey-world", ())
    torch.testing.assert_close(balanced, expected, rtol=1e-5, atol=1e-7)
    before = page.run("document.getElementById('scene').src")
    page.run("(slider => { slider.value = 1; slider.oninput(); })(document.getElementById('exposure'))")
    page.wait(f"document.getElementById('scene').src !== '{before}'")
    page.run("document.getElementById('split').focus()")
    page.press("ArrowRight", 39)
    assert page.run("document.getElementById('stack').style.getPropertyValue('--split')") == "51%"
    page.size(390, 800)  # a phone's width: nothing is cut off
    assert page.run("document.documentElement.scrollWidth") <= 390
    assert page.run(
        "[...document.querySelectorAll('input, select, button')].every(e => "
        "(e.labels?.length || e.ariaLabel || e.textContent.trim()))"
    )


def test_from_the_disk(files, tmp_path):
    folder, own, other = files
    with open_page((folder / "site" / "index.html").as_uri(), tmp_path / "profile") as page:
        page.wait(STATE)
        wait_for(page, "astronaut")
        assert "agrees with mwdn" in page.run("document.getElementById('checked').textContent")
        check_files(page, folder, own, other)
        check_controls(page)
        assert not page.errors


def test_from_a_static_host_whose_connection_is_lost(files, tmp_path):
    folder, own, _ = files
    with static_host(folder / "site") as address, open_page(address, tmp_path / "profile") as page:
        page.wait(STATE)
        wait_for(page, "astronaut")
        # Nothing can be sent: the page's own policy forbids it.
        assert page.run(f"fetch('{address}').then(() => 'sent', () => 'refused')") == "refused"
        page.errors.clear()  # that refusal
        page.command("Network.enable")
        offline = {"offline": True, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        page.command("Network.emulateNetworkConditions", **offline)
        page.drop("#capture", folder / "capture.png")
        wait_for(page, "capture.png")
        check_scene(page, own, folder / "capture.png")
        assert not page.errors


@pytest.mark.usefixtures("files")
def test_a_grey_camera(tmp_path):
    """Its page said that WebAssembly computes another picture, and did not start."""
    write_frame(tmp_path / "grey.png", psf_frame(0, 12)[..., 1:2])
    grey = Calibration.from_file(tmp_path / "grey.png", bit_depth=12)
    write_capture(tmp_path / "capture.png", grey, "coffee", maximum=4095)
    green = read_frame(tmp_path / "capture.png")[..., 1:2]
    write_frame(tmp_path / "capture.png", np.ascontiguousarray(green))
    write_site(tmp_path / "site", tmp_path / "grey.png", "--bit-depth", "12")
    with open_page((tmp_path / "site" / "index.html").as_uri(), tmp_path / "profile") as page:
        page.wait(STATE)
        wait_for(page, "astronaut")
        page.drop("#capture", tmp_path / "capture.png")
        wait_for(page, "capture.png")
        check_scene(page, grey, tmp_path / "capture.png")
        assert not page.errors


@pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm, for axe-core")
def test_axe_finds_no_violation(files, tmp_path):
    """Screenshots go to results/acceptance/site; look at them."""
    folder, _, _ = files
    with open_page((folder / "site" / "index.html").as_uri(), tmp_path / "profile") as page:
        page.wait(STATE)
        wait_for(page, "astronaut")
        page.drop("#psf", folder / "other.png")
        page.drop("#capture", folder / "of-the-other.png", folder / "capture.png")
        wait_for(page, "of-the-other.png")
        page.run("document.getElementById('format').open = true")
        assert not violations(page, fetch_axe(tmp_path), Path("results/acceptance/site"))


def test_a_missing_file_is_named(files, tmp_path):
    folder, _, _ = files
    site = tmp_path / "site"
    site.mkdir()
    for path in (folder / "site").iterdir():
        if path.name != "runtime-wasm.js":
            (site / path.name).symlink_to(path)
    with open_page((site / "index.html").as_uri(), tmp_path / "profile") as page:
        page.wait(f"{STATE}?.classList.contains('wrong')")
        assert said(page) == "runtime-wasm.js is missing. Copy the whole folder."
