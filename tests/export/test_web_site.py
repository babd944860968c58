"""The folder of a static page: what it holds, and that nothing of others is lost. The page itself: `test_site_page`."""

import base64
import gzip
import json
import re
import shutil
import subprocess
from dataclasses import replace

import cv2
import jaxtyping
import numpy as np
import pytest
import torch

from cameras import contour_psf
from made import trained
from mwdn import Calibration, Reconstructor
from mwdn.calibration import FrameFormat
from mwdn.calibration.corrections import Corrections
from mwdn.cli.app import main
from mwdn.errors import ExportError, ParameterError
from mwdn.export import export_site, web_runtime
from mwdn.export.exporter import agreement
from mwdn.export.network_models import NetworkModels, run_models
from mwdn.export.site import SITE_FILES
from mwdn.export.site_scripts import MODULES, joined_modules, read_static
from mwdn.io.images import decode_frame
from mwdn.networks import build

pytest.importorskip("onnx", reason="The extra is missing: pip install 'mwdn[export]'")
pytest.importorskip("onnxruntime", reason="The extra is missing: pip install 'mwdn[export]'")

SIZE = 38, 48


def camera(seed=1, **fields):
    generator = torch.Generator().manual_seed(seed)
    psf = contour_psf(SIZE, cell=12, generator=generator).expand(1, 3, *SIZE).contiguous()
    return Calibration(psf / psf.sum((-2, -1), keepdim=True), **fields)


def network():
    torch.manual_seed(3)
    return trained(build("wiener"), torch.Generator().manual_seed(2))


@pytest.fixture(scope="module")
def runtime(tmp_path_factory):
    """As the npm package, with other contents."""
    folder = tmp_path_factory.mktemp("runtime")
    (folder / "dist").mkdir()
    (folder / "package.json").write_text(
        json.dumps({"name": "onnxruntime-web", "version": web_runtime.RUNTIME_VERSION})
    )
    for name in web_runtime.RUNTIME_FILES:
        (folder / "dist" / name).write_bytes(name.encode())
    return folder


@pytest.fixture(scope="module")
def site(tmp_path_factory, runtime):
    defects = torch.zeros(1, 1, 2 * SIZE[0], 2 * SIZE[1], dtype=torch.bool)
    defects[..., 5, 7] = True
    taken = camera(
        frames=FrameFormat(bit_depth=12, bin=2),
        dark=torch.full((1, 1, 2 * SIZE[0], 2 * SIZE[1]), 0.01),
        corrections=Corrections(defects=defects),
    )
    jaxtyping.config.update("jaxtyping_disable", True)
    folder = tmp_path_factory.mktemp("export") / "site"
    done = export_site(network(), taken, folder, runtime=runtime, name="psf.png")
    jaxtyping.config.update("jaxtyping_disable", False)
    return done, taken


def unpack(folder, script, name):
    entry = re.search(rf'mwdnFiles\["{re.escape(name)}"\] = (.*);', (folder / script).read_text())
    stored = json.loads(entry[1])
    content = gzip.decompress(base64.b64decode(stored["text"]))
    assert len(content) == stored["length"]
    return content


def read_camera(folder):
    return json.loads(re.match(r"globalThis.mwdnCamera = (.*);\n", (folder / "camera.js").read_text())[1])


def test_the_folder_is_complete_and_loads_nothing_else(site):
    folder = site[0].path
    assert sorted(path.name for path in folder.iterdir()) == sorted(SITE_FILES)
    page = (folder / "index.html").read_text()
    assert set(re.findall(r'(?:src|href)="([^"#]+)"', page)) <= set(SITE_FILES)
    assert "connect-src data: blob:" in page  # the browser itself refuses to send anything
    for name in ("page.js", "page.css", "site.css", "index.html"):
        assert not re.search(r"https?://", (folder / name).read_text()), name


def test_the_camera_is_stored_as_it_is(site):
    done, taken = site
    about = read_camera(done.path)
    assert about["size"] == list(SIZE)
    assert (about["format"]["bit_depth"], about["format"]["bin"]) == (12, 2)
    psf = np.frombuffer(unpack(done.path, "camera.js", "psf"), "<f4").reshape(3, *SIZE)
    np.testing.assert_array_equal(psf, taken.psf[0])
    dark = np.frombuffer(unpack(done.path, "camera.js", "offset"), "<f4")
    np.testing.assert_array_equal(dark, taken.dark.flatten())
    [[pixel, neighbours]] = about["format"]["hot_pixels"]
    assert pixel == 5 * 2 * SIZE[1] + 7
    assert len(neighbours) == 8


def test_the_network_serves_any_camera_of_the_size(site):
    folder = site[0].path
    models = NetworkModels(*(unpack(folder, "network.js", f"{name}.onnx") for name in NetworkModels._fields))
    other = camera(seed=5)
    measurement = torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(4))
    expected = Reconstructor(network(), other, device="cpu", precision="exact")(measurement)
    assert agreement(run_models(models, other.psf, measurement), expected) > 100


def test_the_page_knows_the_result_of_its_first_sample(site):
    done, taken = site
    about = read_camera(done.path)
    frame = decode_frame(unpack(done.path, "camera.js", f"{about['samples'][0]}.png"), "the sample")
    measurement = torch.from_numpy(frame.astype(np.float32) / 65535).movedim(-1, 0)[None]
    scene = Reconstructor(network(), taken, device="cpu", precision="exact")(measurement)
    values = scene.flatten()[:: about["expected"]["step"]]
    np.testing.assert_allclose(about["expected"]["values"], values, rtol=1e-5, atol=1e-5 * float(values.max()))


def test_the_runtime_is_stored_unchanged(site):
    folder = site[0].path
    for kind, name in web_runtime.BINARIES.items():
        assert (folder / web_runtime.LIBRARIES[kind]).read_text() == web_runtime.LIBRARIES[kind]
        assert unpack(folder, f"runtime-{kind}.js", f"{kind}.wasm").decode() == f"{name}.wasm"


def test_modules_become_one_classic_script():
    script = joined_modules()
    assert not re.search(r"^(import|export) ", script, re.MULTILINE)
    top = [
        name
        for module in MODULES
        for name in re.findall(
            r"^(?:export )?(?:async )?(?:const|let|function|class) (\w+)", read_static(f"{module}.js"), re.MULTILINE
        )
    ]
    assert len(top) == len(set(top)) > 50


MEASURE = """
import { readFileSync, writeFileSync } from "node:fs";
import { normalise, toMeasurement } from "./frames.js";
import { decodeNpy } from "./npy.js";
const read = (name) => decodeNpy(new Uint8Array(readFileSync(`${name}.npy`)));
const plain = { bit_depth: null, gamma: null, bgr: false, bin: 1 };
const [offset, flat] = ["dark", "flat"].map((name) => normalise(read(name), plain));
const format = { ...plain, offset, flat, ...JSON.parse(process.argv[2]) };
writeFileSync("measurement.bin", toMeasurement(read("capture"), format).data);
"""


def measured_by_the_page(folder, format, **images):
    """The measurement that the page makes of a capture, a dark frame and a flat field, all (H, W, C)."""
    for name, image in images.items():
        np.save(folder / f"{name}.npy", image)
    for name in ("frames.js", "hot_pixels.js", "npy.js", "png.js"):
        (folder / name).write_text(read_static(name), encoding="utf-8")
    (folder / "package.json").write_text('{"type": "module"}', encoding="utf-8")
    (folder / "measure.js").write_text(MEASURE, encoding="utf-8")
    subprocess.run(["node", "measure.js", json.dumps(format)], cwd=folder, check=True, timeout=60)
    return np.fromfile(folder / "measurement.bin", "<f4")


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
@pytest.mark.parametrize(("depth", "maximum"), [(12, 4095), (None, 65535), (None, 4095)])
def test_the_page_keeps_the_plateau_of_saturated_pixels(tmp_path, depth, maximum):
    """Dark frame and flat field gave 7 % saturated pixels different values, and the picture lost 3 dB."""
    numbers = np.random.default_rng(3)
    smooth = np.kron(numbers.random((8, 10, 3)), np.ones((8, 8, 1)))
    light = smooth + 0.02 * numbers.random(smooth.shape)
    frame = (light / np.quantile(light, 0.93) * maximum).clip(0, maximum).round().astype(np.uint16)
    dark, flat = 0.1 * numbers.random(smooth.shape), 1 + 0.2 * numbers.random(smooth.shape)
    dark, flat = dark.astype(np.float32), flat.astype(np.float32)
    given = measured_by_the_page(tmp_path, {"bit_depth": depth}, capture=frame, dark=dark, flat=flat)
    dark, flat = (torch.from_numpy(image).movedim(-1, 0)[None] for image in (dark, flat))
    wanted = FrameFormat(bit_depth=depth).to_measurement(frame, dark, Corrections(flat=flat))
    assert (wanted == wanted.amax((-2, -1), keepdim=True)).sum() > 300  # the plateau
    np.testing.assert_allclose(given, wanted.flatten(), atol=1e-6)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
@pytest.mark.parametrize(
    ("mosaic", "excess", "is_found"),
    [(None, 0.4, True), ("rggb", 0.4, True), (None, 0.05, False), (None, 0.0, False)],
    ids=["colour", "mosaic", "faint", "none"],
)
def test_the_page_finds_the_hot_pixels_that_the_package_finds(tmp_path, mosaic, excess, is_found):
    numbers = np.random.default_rng(4)
    channels = 1 if mosaic else 3
    light = cv2.resize(numbers.random((5, 6, 3), np.float32), (120, 98)).reshape(98, 120, 3)[..., :channels]
    light = 0.1 + 0.4 * light + numbers.normal(0, 0.01, light.shape)
    for y, x in ((30, 40), (31, 40), (30, 41), (0, 60), (97, 5), (60, 119)):  # three together, three at the border
        light[y, x, -1] += excess
    frame = (light.clip(0, 1) * 4095).round().astype(np.uint16)
    dark, flat = np.full((98, 120, 1), 0.05, np.float32), np.ones((98, 120, 1), np.float32)
    format = {"bit_depth": 12, "mosaic": mosaic, "hot_pixels": None}
    given = measured_by_the_page(tmp_path, format, capture=frame, dark=dark, flat=flat)
    frames, corrections = FrameFormat(bit_depth=12, mosaic=mosaic), Corrections(flat=torch.ones(1, 1, 98, 120))
    offset = torch.from_numpy(dark).movedim(-1, 0)[None]
    wanted = frames.to_measurement(frame, offset, corrections.of_capture)
    assert bool((wanted != frames.to_measurement(frame, offset, corrections)).any()) == is_found
    np.testing.assert_allclose(given, wanted.flatten(), atol=1e-6)


def test_files_of_others_stay(runtime, tmp_path):
    (tmp_path / "index.html").write_text("<!doctype html> mine")
    with pytest.raises(ParameterError, match=r"index\.html` was not written by this command"):
        export_site(network(), camera(), tmp_path, runtime=runtime)
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]


def test_a_site_of_a_grey_camera_replaces_an_earlier_one(site, runtime, tmp_path, unchecked):
    """The page computes in the network's channels, grey as equal colours."""
    (tmp_path / "index.html").write_bytes((site[0].path / "index.html").read_bytes())
    (tmp_path / "notes.txt").write_text("mine")
    grey = camera(seed=2)
    done = export_site(network(), replace(grey, psf=grey.psf[:, :1]), tmp_path, runtime=runtime)
    assert read_camera(tmp_path)["images"]["psf"]["channels"] == 1
    assert done.agreement > 100
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*SITE_FILES, "notes.txt"])


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("fista", r"\(fista\) must be a network"),
        (build("wiener-bank", width=4), r"aligns the PSF to each capture"),
        (build("wiener", authors_form=True), r"takes the PSF as its file stores it"),  # it agreed to 7 dB
    ],
)
def test_methods_that_a_page_cannot_run(method, message, runtime, tmp_path):
    with pytest.raises(ParameterError, match=message):
        export_site(method, camera(), tmp_path / "site", runtime=runtime)
    assert not (tmp_path / "site").exists()


def test_the_runtime_is_checked(runtime, tmp_path, monkeypatch):
    with pytest.raises(ExportError, match=r"unpacked npm package onnxruntime-web .*npm install"):
        web_runtime.read_runtime(tmp_path)
    other = tmp_path / "other"
    (other / "dist").mkdir(parents=True)
    for name in web_runtime.RUNTIME_FILES:
        (other / "dist" / name).touch()
    (other / "package.json").write_text('{"name": "onnxruntime-web", "version": "1.0.0"}')
    with pytest.raises(ExportError, match=r"must be onnxruntime-web 1\.30\.0, but is onnxruntime-web 1\.0\.0"):
        web_runtime.read_runtime(other)

    monkeypatch.setattr(web_runtime, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(web_runtime.shutil, "which", lambda name: None)
    with pytest.raises(ExportError, match=r"npm, which is not installed.*--runtime FOLDER"):
        web_runtime.read_runtime()
    (tmp_path / f"onnxruntime-web-{web_runtime.RUNTIME_VERSION}.tgz").write_bytes(b"something else")
    with pytest.raises(ExportError, match=r"must have the hash sha512-q0y"):
        web_runtime.read_runtime()


def test_a_failed_fetch_is_named_and_leaves_nothing(tmp_path, monkeypatch, caplog):
    npm = tmp_path / "npm"
    npm.write_text("#!/bin/sh\necho 'npm error code ENOTFOUND' >&2\nexit 1\n")
    npm.chmod(0o755)
    monkeypatch.setattr(web_runtime, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(web_runtime.shutil, "which", lambda name: str(npm))
    with pytest.raises(ExportError, match=r"cannot be fetched by npm: npm error code ENOTFOUND\."):
        web_runtime.read_runtime()
    assert not list((tmp_path / "cache").glob("*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--web", "a.png", "--psf", "b.png"], "`--web` names the camera"),
        (["--psf", "a.png", "--runtime", "folder"], "`--web CAMERA`"),
        (["--web", "a.png", "--precision", "int8"], "are for files"),
    ],
)
def test_wrong_calls(arguments, message, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["export", *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err.replace("\n", " ")
