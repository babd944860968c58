"""Entries of other packages: the example of examples/plugin, and packages that are broken."""

import json
import math
import sys
import tomllib
import warnings
from pathlib import Path

import httpx2 as httpx
import numpy as np
import pytest
import torch

import mwdn
from mwdn.capture import SOURCES, open_source
from mwdn.capture.recipe import CameraTable, CaptureRecipe
from mwdn.capture.set_up import open_camera
from mwdn.data.pairs import PairFile
from mwdn.errors import CameraError, ParameterError, PluginError, UnknownNameError
from mwdn.io.pictures import dark_scene
from mwdn.networks import NETWORKS
from mwdn.optics import MASKS, Setup, sample_camera
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.server import make_server
from mwdn.runtime import plugins
from mwdn.solvers import SOLVERS
from preview_server import LIMITS

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "plugin"
REGISTRIES = (SOLVERS, NETWORKS, MASKS, SOURCES)
SIZE = (48, 52)


@pytest.fixture
def install(tmp_path, monkeypatch):
    """``install(name, {group: {entry: place}})`` makes the metadata of an installed package, for this test."""
    monkeypatch.syspath_prepend(tmp_path)

    def call(name, groups):
        folder = tmp_path / f"{name.replace('-', '_')}-0.1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
        lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in table.items()) for group, table in groups.items()]
        (folder / "entry_points.txt").write_text("\n".join(lines))
        for registry in REGISTRIES:
            registry.refresh()
        return tmp_path

    yield call
    monkeypatch.undo()
    for registry in REGISTRIES:
        registry.refresh()
    sys.modules.pop("mwdn_example", None)


@pytest.fixture
def example(install, monkeypatch):
    """The package of examples/plugin, as its pyproject.toml describes it."""
    monkeypatch.syspath_prepend(EXAMPLE)
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return install(project["name"], project["entry-points"])


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A PSF and a capture."""
    monkeypatch.chdir(tmp_path)
    psf = sample_camera(0, SIZE)
    light = mwdn.convolve(dark_scene("cat", SIZE, 30), psf)
    for name, image in (("psf", psf), ("capture", light)):
        np.save(f"{name}.npy", (image / image.max())[0].movedim(0, -1).numpy())
    return psf, light


@pytest.mark.usefixtures("example")
def test_a_solver_reconstructs_by_its_name_on_the_command_line(run, files):
    line = "reconstruct capture.npy --psf psf.npy --method richardson-lucy --iterations 60 --format npy --background 0"
    code, _, err = run(f"{line} --bin 1 --no-trust --out out")
    assert (code, err) == (0, "")
    assert "at least 1" in run("reconstruct capture.npy --psf psf.npy --method richardson-lucy --iterations 0")[2]
    psf, _ = files
    scene = torch.from_numpy(np.load("out/capture.npy")).movedim(-1, 0)[None]
    measured = torch.from_numpy(np.load("capture.npy")).movedim(-1, 0)[None]
    unexplained = [
        (mwdn.convolve(guess, mwdn.Calibration(psf).psf) - measured).norm()
        for guess in (scene, measured.mean((-2, -1), keepdim=True).expand_as(measured))
    ]
    assert unexplained[0] < 0.1 * unexplained[1]


@pytest.mark.usefixtures("example")
def test_methods_are_listed_with_their_options(run):
    out = run("methods")[1]
    assert "richardson-lucy" in out
    assert "residual" in out
    assert "Options, as --name value" in run("methods richardson-lucy")[1]
    assert "channels between the layers" in run("methods residual")[1]


@pytest.mark.usefixtures("example")
def test_a_network_is_loaded_by_its_name_and_reconstructs_on_the_command_line(run, files):
    network = mwdn.build("residual", width=2)
    mwdn.weights.save_network("mine.safetensors", network, "residual", {"width": 2})
    assert type(mwdn.load_network("mine.safetensors")) is NETWORKS["residual"]
    line = "reconstruct capture.npy --psf psf.npy --method mine.safetensors --format npy --background 0 --no-trust"
    assert run(f"{line} --out out")[0] == 0
    _, measurement = files
    psf = mwdn.Calibration.from_file("psf.npy", background=0.0).psf
    expected = network.eval()(measurement / measurement.max(), psf)[0].movedim(0, -1)
    np.testing.assert_allclose(np.load("out/capture.npy"), expected.detach().numpy(), atol=2e-2)


@pytest.mark.usefixtures("example")
def test_a_mask_is_a_command_of_design(run, tmp_path):
    assert "ring" in run("design", "--help")[1]
    small = "--pixels 64 64 --bin 1 --wavelengths 1 --aperture-mm 0.4 0.4 --radius-mm 0.1 --pitch-um 8"
    code, _, err = run(*f"design ring {small} --out {tmp_path / 'ring'}".split())
    assert (code, err) == (0, "")
    assert (tmp_path / "ring" / "psf.tif").is_file()


@pytest.mark.usefixtures("example")
def test_the_ring_is_as_large_as_it_says_and_every_parameter_of_the_network_learns():
    mask = MASKS["ring"](radius_mm=0.1, width_mm=0.02, pitch_um=1.0).build(Setup(aperture_mm=(0.4, 0.4)))
    assert mask.values.sum().item() * mask.pitch_um**2 == pytest.approx(2 * math.pi * 100 * 20, rel=0.02)
    network = mwdn.build("residual", width=2)
    network(torch.rand(1, 3, 19, 24), torch.rand(1, 3, 19, 24)).sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in network.parameters())


@pytest.mark.usefixtures("example")
def test_a_camera_is_opened_by_its_name():
    with open_source("test-card,width=8,height=4") as camera:
        first, second = camera.read(), camera.read()
    assert first.array[..., 0].tolist() == 4 * [[0, 511, 1023, 1535, 2047, 2559, 3071, 3583]]
    assert second.array[0, :, 0].tolist() == [511, 1023, 1535, 2047, 2559, 3071, 3583, 0]
    with pytest.raises(UnknownNameError, match="width"):
        open_source("test-card,with=8")


@pytest.mark.filterwarnings("always")
def test_a_broken_plugin_is_named_and_the_others_work(install, run):
    folder = install(
        "mwdn-broken",
        {"mwdn.solvers": {"lost": "no_such_module:Solver", "three": "sums:THREE", "ends": "ending:Solver"}},
    )
    (folder / "sums.py").write_text("THREE = 3\n")
    (folder / "ending.py").write_text("raise SystemExit('licence expired')\n")
    code, out, err = run("methods")
    assert code == 0
    assert "admm" in out
    lines = err.splitlines()
    assert [line.partition(" in `")[0] for line in lines] == ["Warning: `ends`", "Warning: `lost`", "Warning: `three`"]
    assert all("`pip uninstall mwdn-broken`" in line for line in lines)
    assert "SystemExit: licence expired" in lines[0]
    assert "must be a class whose objects are called" in lines[2]
    assert isinstance(mwdn.solvers.build("wiener"), mwdn.solvers.Wiener)
    with pytest.raises(ParameterError, match="No module named 'no_such_module'"):
        mwdn.solvers.build("lost")


def test_a_plugin_cannot_replace_a_method_of_this_package_or_of_another(install):
    install("a-first", {"mwdn.solvers": {"mine": "mwdn.solvers:Fista"}})
    taken = dict.fromkeys(("mine", "admm", "universal", "unet"), "mwdn.solvers:Wiener")
    install("b-second", {"mwdn.solvers": taken})
    with pytest.warns(UserWarning, match="is ignored") as caught:
        assert SOLVERS["mine"] is mwdn.solvers.Fista
    assert SOLVERS["admm"] is mwdn.solvers.Admm
    assert "universal" not in SOLVERS
    assert [str(warning.message).split("`")[-2] for warning in caught] == ["mwdn", "a-first", "mwdn", "mwdn"]


WRONG = """
from dataclasses import dataclass

class Base:
    def __init__(self, gain: float = 1.0):
        self.gain = gain

class Inherits(Base):
    def __call__(self, measurement, psf):
        return measurement * self.gain

class Half:
    def __call__(self, measurement, psf):
        return measurement[..., ::2, ::2]

class Bare:
    # Options without annotations, and one without a default.
    def __init__(self, needed, gain=1.0, mode="fast", inverted=False):
        assert (type(gain), mode, inverted) == (float, "slow", True)
        self.gain = gain

    def __call__(self, measurement, psf):
        return measurement * self.gain

class Numpy:
    def __call__(self, measurement, psf):
        return measurement.numpy()

@dataclass(frozen=True)
class Plane:
    def build(self, setup):
        return 3
"""


@pytest.mark.filterwarnings("always")
def test_what_plugins_return_is_checked_and_inherited_options_work(install, run, files):
    """Each ended in a traceback."""
    solvers = {"heir": "Inherits", "numeric": "Numpy", "half": "Half", "bare": "Bare"}
    groups = {"mwdn.solvers": {name: f"wrongs:{kind}" for name, kind in solvers.items()}}
    folder = install("mwdn-wrong", groups | {"mwdn.masks": {"plane": "wrongs:Plane", "lost": "no_such_module:Mask"}})
    (folder / "wrongs.py").write_text(WRONG)
    line = "reconstruct capture.npy --psf psf.npy --background 0 --bin 1 --no-trust --out out --method"
    assert run(f"{line} heir --gain 2")[0] == 0
    code, _, err = run(f"{line} numeric")
    assert (code, "must return a tensor (1, 3, 48, 52), not ndarray" in err) == (1, True), err
    code, _, err = run(f"{line} half")
    assert (code, "half must return a tensor (1, 3, 48, 52), not Tensor (1, 3, 24, 26)" in err) == (1, True), err
    assert run(f"{line} bare --needed 3 --gain 2 --mode slow --inverted true")[0] == 0
    code, _, err = run(f"{line} bare --gain 2")
    assert (code, "`needed` of the solver 'bare' is missing" in err) == (2, True), err
    code, out, _ = run("methods bare")
    assert (code, "needed: any value, required" in " ".join(out.split())) == (0, True), out
    code, _, err = run("design plane")
    assert (code, "must return a `mwdn.optics.Mask`, not 3" in err) == (2, True), err
    code, _, err = run("design lost")
    assert (code, "No module named 'no_such_module'" in err) == (2, True), err


FAILING = """
import sys

import torch
from mwdn.networks import Network

class Raises:
    calls = 0

    def __call__(self, measurement, psf):
        Raises.calls += 1
        if Raises.calls == 2:
            return measurement
        raise RuntimeError("boom")

class Exits:
    def __call__(self, measurement, psf):
        sys.exit(0)

class Large:
    def __call__(self, measurement, psf):
        raise MemoryError

class ExitsWhenMade(Network):
    def __init__(self):
        super().__init__()
        sys.exit(0)

    def prepare(self, psf, size):
        return psf

    def reconstruct(self, measurement, prepared):
        return measurement

class Unmade:
    def __init__(self):
        raise ValueError("no licence")

    def __call__(self, measurement, psf):
        return measurement
"""


@pytest.fixture
def failing(install):
    """Plugins that raise an error in all calls but the second, or exit, or cannot be made."""
    names = {"raises": "Raises", "exits": "Exits", "large": "Large", "unmade": "Unmade"}
    groups = {"mwdn.solvers": {name: f"fails:{kind}" for name, kind in names.items()}}
    folder = install("mwdn-failing", groups | {"mwdn.networks": {"ends": "fails:ExitsWhenMade"}})
    (folder / "fails.py").write_text(FAILING)
    yield
    sys.modules.pop("fails", None)


@pytest.mark.usefixtures("failing", "files")
def test_errors_of_a_plugin_name_it_and_cost_one_capture(run):
    """They ended a folder of captures in a traceback, or the command as if all was well."""
    Path("captures").mkdir()
    for name in ("a", "b"):
        Path(f"captures/{name}.npy").write_bytes(Path("capture.npy").read_bytes())
    line = "reconstruct captures --psf psf.npy --background 0 --bin 1 --no-trust --out out --method"
    for name, why, failed in (("raises", "RuntimeError: boom", 1), ("exits", "SystemExit: 0", 2)):
        code, out, err = run(f"{line} {name}")
        assert (code, err.count(f"The plugin `{name}` (module `fails`) failed: {why}.")) == (1, failed), err
        assert f"{2 - failed} of 2 captures" in out
    with PairFile.create("pairs.h5", measurement_shape=(*SIZE, 3), scene_shape=(*SIZE, 3)) as file:
        file.append(torch.rand(3, *SIZE), torch.rand(3, *SIZE))
    code, out, err = run("evaluate wiener exits --data pairs.h5 --psf psf.npy --background 0 --no-lpips --json")
    assert (code, "no scores: The plugin `exits` (module `fails`) failed" in err) == (1, True), err
    assert (list(json.loads(out)["methods"]), list(json.loads(out)["failed"])) == (["wiener"], ["exits"])
    code, _, err = run("--debug evaluate exits --data pairs.h5 --psf psf.npy --background 0 --no-lpips")
    assert (code, "sys.exit(0)" in err) == (2, True), "the line that failed"
    code, _, err = run(f"{line} unmade")
    assert (code, "The plugin `unmade` (module `fails`) failed: ValueError: no licence." in err) == (2, True), err
    code, _, err = run(f"{line} large")
    assert (code, err.count("needs more memory than cpu has free")) == (1, 2), err
    with pytest.raises(PluginError, match=r"^The plugin `ends` \(module `fails`\) failed: SystemExit: 0\.$"):
        mwdn.build("ends")


@pytest.mark.usefixtures("failing")
def test_errors_of_the_callers_own_object_pass(files):
    psf, light = files
    with pytest.raises(RuntimeError, match=r"^boom$"):
        mwdn.Reconstructor(SOLVERS["raises"](), mwdn.Calibration(psf), device="cpu")(light)


@pytest.mark.usefixtures("failing")
def test_the_page_outlives_a_plugin_that_exits(files):
    """The worker ended, no later request was answered, and the server still called itself healthy."""
    psf, _ = files
    server = make_server(StoredCameras(LIMITS, None, {"camera": mwdn.Calibration(psf)}), LIMITS, device="cpu")
    server.start()
    capture = Path("capture.npy").read_bytes()
    try:
        for method, status in (("exits", 500), ("raises", 500), ("wiener", 200)):
            data = {"camera": "camera", "method": method, "trust": "false"}
            answer = httpx.post(f"{server.url}reconstruct", files={"capture": capture}, data=data, timeout=120)
            assert answer.status_code == status, answer.text[:300]
            assert status == 200 or f"The plugin `{method}` (module `fails`) failed" in answer.json()["error"]
    finally:
        server.stop()


@pytest.mark.parametrize("line", ["--help", "reconstruct --help", "design contour --help", "recipes"])
def test_plugins_are_not_looked_for_without_need(run, line, monkeypatch):
    for registry in REGISTRIES:
        registry.refresh()
    monkeypatch.setattr(plugins, "entry_points", lambda **_: pytest.fail("looked for plugins"))
    with warnings.catch_warnings():
        assert run(line)[0] == 0


BROKEN_CAMERAS = """
import numpy as np
from mwdn.capture import CameraFrame, CameraSource, Kind

class Camera(CameraSource):
    def __init__(self, *, fault=""):
        super().__init__("broken")
        self.fault = fault

    def open(self):
        self.fail("open")

    def read(self):
        self.fail("read")
        arrays = {"axes": np.zeros((4, 4), np.uint8), "type": np.zeros((4, 4, 1), np.float32)}
        return None if self.fault == "none" else CameraFrame(array=arrays.get(self.fault), bit_depth=8)

    def close(self):
        self.fail("close")

    def fail(self, what):
        if self.fault == what:
            raise OSError(19, "No such device")

def make_none():
    return None

BROKEN, NO_CAMERA = Kind(Camera), Kind(make_none)
"""


@pytest.fixture
def broken_cameras(install):
    """A plugin's camera that fails where its option says, and a plugin that makes no camera."""
    folder = install("mwdn-broken", {"mwdn.cameras": {"broken": "broken:BROKEN", "no-camera": "broken:NO_CAMERA"}})
    (folder / "broken.py").write_text(BROKEN_CAMERAS)
    yield
    sys.modules.pop("broken", None)


@pytest.mark.usefixtures("broken_cameras")
def test_errors_of_a_plugins_camera_name_it_and_its_frames_are_checked():
    """They ended a session in a traceback, or as a file that cannot be written."""
    failed = r"^The plugin `broken` \(module `broken`\) failed: OSError: \[Errno 19\] No such device\.$"
    with pytest.raises(CameraError, match=failed):
        open_source("broken,fault=open").open()
    for fault, message in (("read", failed), ("none", "a `CameraFrame`, not None"), ("axes", r"\(4, 4\), uint8")):
        with pytest.raises(CameraError, match=message):
            open_source(f"broken,fault={fault}").read()
    with pytest.raises(CameraError, match=r"\(4, 4, 1\), float32"):
        open_source("broken,fault=type").read()
    with pytest.warns(UserWarning, match="broken was not closed"):
        open_source("broken,fault=close").close()
    with pytest.raises(CameraError, match="`no-camera` must make a `CameraSource`"):
        open_source("no-camera")


@pytest.mark.usefixtures("example")
def test_a_session_takes_a_plugins_camera_without_a_timeout():
    """Its options had to have the `timeout_s` of the recipe, which replaced that of the camera's string."""
    assert open_camera(CaptureRecipe(CameraTable("test-card,width=8", timeout_s=3.0))).timeout_s == 3.0
    assert open_camera(CaptureRecipe(CameraTable("v4l2:0,timeout_s=7.5", timeout_s=3.0))).timeout_s == 7.5
