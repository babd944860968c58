"""What is exported is the same function, in onnxruntime and without torch."""

import itertools
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import jaxtyping
import numpy as np
import pytest
import torch
from torch import nn

from cameras import contour_psf
from full_disk import full_after
from made import trained
from mwdn import Calibration, Reconstructor, read_frame, to_display
from mwdn.calibration import FrameFormat
from mwdn.cli.app import main
from mwdn.errors import ExportError, MissingPackageError, ParameterError, ShapeError
from mwdn.export import export, read_about, run_file
from mwdn.export.dft import column_matrices, inverse_row_matrix, row_matrix
from mwdn.export.exporter import MIN_AGREEMENT, agreement, simulate_captures
from mwdn.export.model_file import serialise
from mwdn.export.onnx_program import REAL_HANDLERS
from mwdn.fourier.filtering import filter_image
from mwdn.fourier.wiener import deconvolution_grid, wiener_transfer
from mwdn.io.images import srgb_encode, write_frame
from mwdn.networks import NETWORKS, build
from mwdn.optics.saturation import saturated_pixels
from mwdn.solvers import SOLVERS, Wiener
from mwdn.solvers import build as build_solver
from mwdn.weights.checkpoint import save_network

onnx = pytest.importorskip("onnx", reason="The extra is missing: pip install 'mwdn[export]'")
pytest.importorskip("onnxruntime", reason="The extra is missing: pip install 'mwdn[export]'")
pytestmark = pytest.mark.usefixtures("unchecked")  # an open batch is no number: its checks do not know that

SIZE = 38, 48
ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "onnx_only.py"


def camera(size=SIZE, channels=3):
    psf = contour_psf(size, cell=12, generator=torch.Generator().manual_seed(1)).expand(1, channels, *size).contiguous()
    return Calibration(psf / psf.sum((-2, -1), keepdim=True), FrameFormat(bit_depth=12))


def network(name, **options):
    """Narrow, as after some training."""
    torch.manual_seed(3)
    network = build(name, **({} if name in ("wiener", "le-admm") else {"width": 4} | options))
    return trained(network, torch.Generator().manual_seed(2))


class Unchanged(nn.Module):
    """The quickest to export."""

    def forward(self, measurement, psf):
        return measurement * 1.0


class Rectified(nn.Module):
    """A convolution, so that it has weights for lower precisions, and one more operation."""

    def __init__(self):
        super().__init__()
        self.convolution = nn.Conv2d(3, 3, 3, padding=1)

    def forward(self, measurement, psf):
        return self.convolution(measurement).relu()


class Saturated(nn.Module):
    """Marks saturated pixels, as `pyramid` does."""

    def forward(self, measurement, psf):
        return torch.where(saturated_pixels(measurement), 2.0, measurement)


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory):
    """A file that returns captures as they are, less a dark frame."""
    path = tmp_path_factory.mktemp("unchanged") / "camera.onnx"
    export(Unchanged(), replace(camera(), dark=torch.zeros(1, 3, *SIZE)), path)
    return path


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A narrow MWDN-CPSF as a file, and the network."""
    jaxtyping.config.update("jaxtyping_disable", True)
    mwdn = network("mwdn-cpsf")
    done = export(mwdn, camera(), tmp_path_factory.mktemp("export") / "camera.onnx")
    jaxtyping.config.update("jaxtyping_disable", False)
    return done, mwdn


def random_batch(generator, count=2, channels=3):
    return torch.rand(count, channels, *SIZE, generator=generator)


@pytest.mark.parametrize(("given", "length"), [(8, 8), (5, 9), (7, 7), (320, 480), (270, 420), (1, 1), (13, 31)])
def test_matrices_are_those_of_the_transform(given, length, generator):
    rows = torch.randn(3, given, generator=generator)
    half = length // 2 + 1
    found = (rows @ row_matrix(given, length)).numpy()
    expected = np.fft.rfft(rows.double().numpy(), n=length)
    np.testing.assert_allclose(found[:, :half] + 1j * found[:, half:], expected, atol=1e-5 * length**0.5)
    parts = np.concatenate([expected.real, expected.imag], axis=1).astype(np.float32)
    again = torch.from_numpy(parts) @ inverse_row_matrix(length, given)
    np.testing.assert_allclose(again, rows, atol=1e-5)


@pytest.mark.parametrize(
    ("length", "given", "kept"), [(8, 8, 8), (480, 320, 480), (480, 480, 320), (31, 13, 31), (45, 45, 20), (1, 1, 1)]
)
@pytest.mark.parametrize("inverse", [False, True])
def test_columns_in_two_factors(length, given, kept, inverse, generator):
    """The products of the docstring, written out with sums over n1 and n2."""
    column = torch.complex(*torch.randn(2, given, generator=generator))
    matrices = column_matrices(length, given, kept, inverse=inverse)
    points = matrices.points
    padded = torch.cat([column, column.new_zeros(matrices.rows * points - given)]).reshape(-1, points)
    sums = matrices.first @ torch.cat([padded.real, padded.imag])
    sums = matrices.second @ sums.reshape(matrices.parts, 2 * points, 1)
    real, imaginary = sums.reshape(matrices.parts, 2, -1).unbind(1)
    found = torch.complex(real, imaginary).T.flatten()[:kept]
    transform = np.fft.ifft if inverse else np.fft.fft
    expected = transform(column.to(torch.complex128).numpy(), n=length)[:kept]
    np.testing.assert_allclose(found, expected, atol=1e-5 * (1 if inverse else length**0.5))


class Filter(nn.Module):
    """One filter on a grid of its own: what a network does at each of its scales."""

    def __init__(self, boundary):
        super().__init__()
        self.boundary = boundary

    def forward(self, measurement, psf):
        grid = deconvolution_grid(measurement.shape[-2:], self.boundary)
        return filter_image(measurement, wiener_transfer(psf, 1e-2, grid), grid, self.boundary)


@pytest.mark.parametrize(("size", "boundary"), [((17, 23), "circular"), ((16, 30), "taper"), ((19, 29), "zero")])
def test_a_filter_of_any_size(size, boundary, tmp_path):
    done = export(Filter(boundary), camera(size), tmp_path / "filter.onnx", least=120)
    assert done.agreement >= 120


def test_bound_network_is_the_same_function_for_any_batch(exported, generator):
    done, mwdn = exported
    assert done.agreement >= 100
    exact = Reconstructor(mwdn, camera(), device="cpu", precision="exact")
    for count in (1, 3):
        batch = random_batch(generator, count)
        assert agreement(run_file(done.path, batch), exact(batch)) >= 100


def test_a_file_is_run_by_its_name_on_floats_of_any_type(exported, generator):
    path, batch = str(exported[0].path), random_batch(generator, 2)
    assert torch.equal(run_file(path, batch.double().requires_grad_()), run_file(path, batch))
    assert read_about(path) == exported[0].about
    with pytest.raises(ShapeError, match="measurement"):
        run_file(path, batch[0])
    for wrong in (batch.numpy(), (255 * batch).byte()):
        with pytest.raises(ParameterError, match="measurement"):
            run_file(path, wrong)


def test_the_file_says_what_it_is(exported):
    import onnx

    done, _ = exported
    about = read_about(done.path)
    assert about == done.about
    assert about["method"] == "MwdnCpsf"
    assert about["psf_hash"] == camera().psf_hash
    assert (about["size"], about["channels"], about["bit_depth"]) == ("38 x 48", "RGB", "12")
    graph = onnx.load(done.path).graph
    assert [each.name for each in (*graph.input, *graph.output)] == ["measurement", "scene"]
    assert "DFT" not in {node.op_type for node in graph.node}


def test_it_runs_without_torch(exported, tmp_path):
    """The example, where neither torch nor mwdn can be imported; its picture is the reconstructor's."""
    import cv2

    done, mwdn = exported
    measurement = simulate_captures(camera(), ("cat",), 3)[:1]
    dark = np.full((*SIZE, 3), 100, np.uint16)
    counts = (measurement[0].movedim(0, -1).numpy() * 3800).round().clip(0) + 100
    cv2.imwrite(str(tmp_path / "capture.png"), counts.astype(np.uint16)[..., ::-1])
    cv2.imwrite(str(tmp_path / "dark.png"), dark)
    blocked = "import runpy, sys; sys.modules['torch'] = sys.modules['mwdn'] = None; "
    blocked += "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    names = [str(tmp_path / name) for name in ("capture.png", "scene.png", "dark.png")]
    call = [sys.executable, "-c", blocked, str(EXAMPLE), str(done.path), *names]
    told = subprocess.run(call, capture_output=True, text=True, check=False, timeout=600)
    assert told.returncode == 0, told.stderr
    assert camera().psf_hash in told.stdout
    taken = replace(camera(), dark=torch.full((1, 3, *SIZE), 100 / 4095))
    scene = Reconstructor(mwdn, taken, device="cpu", precision="exact")(taken.correct(read_frame(names[0])))
    expected = srgb_encode(to_display(scene))[0].movedim(0, -1).numpy() * 255
    assert np.abs(read_frame(names[1]) - expected).max() <= 1


def command(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert ended.value.code == 0


def example(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), *map(str, arguments)])
    runpy.run_path(str(EXAMPLE), run_name="__main__")


@pytest.fixture
def raw(tmp_path):
    """PSF, captures, dark frames and room's light of a colour camera, 83 x 101, neither symmetrical nor grey.

    The room's light has no noise, which `mwdn reconstruct` would remove, and the example subtracts.
    """
    numbers = np.random.default_rng(4)
    write_frame(tmp_path / "psf.png", (numbers.random((83, 101, 3)) ** 40 * 60000).astype(np.uint16))
    write_frame(tmp_path / "capture.png", numbers.integers(2000, 60000, (83, 101, 3), np.uint16))
    write_frame(tmp_path / "dark.png", numbers.integers(0, 2000, (83, 101, 3), np.uint16))
    write_frame(tmp_path / "warm.png", numbers.integers(0, 16000, (83, 101, 3), np.uint16))
    saturated = (read_frame(tmp_path / "capture.png") * 1.09).astype(np.uint16)
    saturated[20:60, 30:60] = 65535  # a seventh of the frame
    write_frame(tmp_path / "saturated.png", saturated)
    write_frame(tmp_path / "room.png", np.linspace([0, 500, 900], 2000, 83 * 101).reshape(83, 101, 3).astype(np.uint16))
    return tmp_path


@pytest.fixture
def as_measured(monkeypatch):
    """`wiener` returns the measurement: the quickest to export, and no detail of the frame is lost in it."""
    monkeypatch.setattr(Wiener, "__call__", lambda self, measurement, psf: measurement * 1.0)


def test_the_example_gives_the_picture_of_mwdn_reconstruct(raw, monkeypatch):
    same_picture("capture.png", ["--bgr", "--gamma", "srgb"], raw, monkeypatch)


@pytest.mark.usefixtures("as_measured")
@pytest.mark.parametrize(
    ("capture", "options"),
    [
        ("capture.tif", []),
        ("capture.png", ["--dark", "dark.png", "--crop", "78", "99", "--bin", "2", "--upside-down", "--bgr"]),
        ("capture.png", ["--ambient", "room.png", "--gamma", "2.2"]),
        ("saturated.png", ["--dark", "warm.png"]),
    ],
)
def test_the_example_reads_frames_as_mwdn_reconstruct_does(capture, options, raw, monkeypatch):
    same_picture(capture, options, raw, monkeypatch)


def same_picture(capture, options, raw, monkeypatch):
    monkeypatch.chdir(raw)
    write_frame(raw / "capture.tif", read_frame("capture.png") / np.float32(65535))
    camera_options = ["--psf", "psf.png", "--background", "0", *options]
    command("export", "wiener", "--regularisation", "1e-3", "--out", "camera.onnx", *camera_options)
    command("reconstruct", capture, "--method", "wiener", "--regularisation", "1e-3", "--no-trust", *camera_options)
    frames = {"dark.png", "room.png", "warm.png"}.intersection(options)
    example(monkeypatch, "camera.onnx", capture, "scene.png", *frames)
    expected = read_frame(f"results/reconstruct/{Path(capture).stem}.png").astype(int)
    assert np.abs(read_frame("scene.png") - expected).max() <= 1


@pytest.mark.usefixtures("as_measured")
@pytest.mark.parametrize("option", ["--mosaic=gbrg --crop 70 90", "--grey"])
def test_the_example_knows_how_colours_are_stored(option, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    numbers, shape = np.random.default_rng(4), (84, 102, 3 if option == "--grey" else 1)
    write_frame(tmp_path / "psf.png", (numbers.random(shape) ** 40 * 60000).astype(np.uint16))
    write_frame(tmp_path / "capture.png", numbers.integers(2000, 60000, shape, np.uint16))
    options = ["--psf", "psf.png", "--background", "0", "--regularisation", "1e-3", *option.split()]
    command("export", "wiener", "--out", "camera.onnx", *options)
    command("reconstruct", "capture.png", "--method", "wiener", "--no-trust", *options)
    example(monkeypatch, "camera.onnx", "capture.png", "scene.png")
    expected = read_frame("results/reconstruct/capture.png").astype(int)
    assert np.abs(read_frame("scene.png") - expected).max() <= 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.onnx", "capture.png", "scene.png"], r"none.onnx cannot be opened: .* File doesn't exist"),
        (["capture.png", "capture.png", "scene.png"], r"capture.png cannot be opened: .*Protobuf parsing failed"),
        (["foreign.onnx", "capture.png", "scene.png"], r"foreign.onnx must be a file that `mwdn export` wrote"),
        (["camera.onnx", "none.png", "scene.png", "dark.png"], r"none.png cannot be read as PNG"),
        (["camera.onnx", "nan.tif", "scene.png", "dark.png"], r"nan.tif cannot be read as PNG.* of finite numbers"),
        (["camera.onnx", "16.png", "scene.png", "dark.png"], r"16.png \(uint16, up to \d+\) must hold .* of 12 bits"),
        (["camera.onnx", "clear.png", "scene.png", "dark.png"], r"clear.png is transparent in parts"),
        (["camera.onnx", "capture.png", "scene.png"], r"capture.png needs a dark frame"),
        (["camera.onnx", "capture.png", "scene.png", "small.png"], r"small.png \(40, 48, 3\) must have the size of"),
        (["camera.onnx", "small.png", "scene.png", "small.png"], r"small.png is \(3, 40, 48\).*takes \[3, 38, 48\]"),
        (["camera.onnx", "capture.png", "scene.xyz", "dark.png"], r"scene.xyz cannot be written: it must end in .png"),
        (["camera.onnx", "capture.png", "no/scene.png", "dark.png"], r"no/scene.png cannot be written"),
    ],
)
def test_the_example_says_in_one_line_what_is_wrong(arguments, message, unchanged, tmp_path, monkeypatch):
    import onnx

    monkeypatch.chdir(tmp_path)
    shutil.copyfile(unchanged, "camera.onnx")
    model = onnx.load("camera.onnx")
    del model.metadata_props[:]
    onnx.save(model, "foreign.onnx")
    for name, size in (("capture.png", SIZE), ("dark.png", SIZE), ("small.png", (40, 48))):
        write_frame(Path(name), np.full((*size, 3), 9, np.uint16))
    write_frame(Path("16.png"), np.full((*SIZE, 3), 5000, np.uint16))
    assert cv2.imwrite("clear.png", np.full((*SIZE, 4), 9, np.uint16))
    assert cv2.imwrite("nan.tif", np.full((*SIZE, 3), np.nan, np.float32))  # `write_frame` refuses NaN
    with pytest.raises(SystemExit, match=message) as ended:
        example(monkeypatch, *arguments)
    assert "\n" not in str(ended.value)
    assert not list(tmp_path.glob("scene.*"))


def test_saturated_pixels_are_found_in_the_file(tmp_path, generator):
    """The first capture is cut off at 70 % of its maximum, the second one is not."""
    seen = random_batch(generator)
    seen[0] = seen[0].clamp(max=0.7)
    done = export(Saturated(), camera(), tmp_path / "camera.onnx")
    marked = run_file(done.path, seen) == 2
    assert torch.equal(marked[0], seen[0] >= 0.995 * 0.7)
    assert not marked[1].any()


@pytest.mark.acceptance
def test_alignment_is_off_in_the_file_alone(tmp_path):
    """With one level of one iteration: more are the same again, see `test_every_network`."""
    bank = network("wiener-bank", finest=8, regularisations=(1e-3,), align=True)
    bank.levels = tuple(replace(level, iterations=1) for level in bank.levels)
    done = export(bank, camera(), tmp_path / "camera.onnx", least=100)
    assert read_about(done.path)["alignment"].startswith("off")
    assert bank.align
    seen = simulate_captures(camera(), ("coffee",), 3)
    expected = Reconstructor(bank, camera(), align=False, device="cpu", precision="exact")(seen)
    assert agreement(run_file(done.path, seen), expected) >= 100


@pytest.mark.acceptance
def test_over_relaxed_iterations_and_recorded_scenes(tmp_path, generator):
    """As in `universal-small` and in a network of `few-pairs`, with two iterations of one level."""
    options = {"align": False, "distortion": 2, "shading": 2, "evidence": True, "mean_light": "gated"}
    bank = network("wiener-bank", finest=8, regularisations=(1e-3,), **options)
    bank.levels = (replace(bank.levels[0], iterations=2),)
    assert bank.levels[0].relaxation > 1
    bank.distortion.copy_(0.05 * torch.randn(2, 6, generator=generator))
    bank.shading.copy_(0.2 * torch.randn(3, 6, generator=generator))
    done = export(bank, camera(), tmp_path / "camera.onnx", least=100)
    seen = simulate_captures(camera(), ("coffee",), 3)
    assert agreement(run_file(done.path, seen), Reconstructor(bank, camera(), precision="exact")(seen)) >= 100


@pytest.mark.acceptance
@pytest.mark.parametrize("name", NETWORKS)
def test_every_network(name, tmp_path):
    export(network(name), camera((64, 72)), tmp_path / "camera.onnx", least=100)


@pytest.mark.acceptance
def test_plug_and_play(tmp_path):
    """After one iteration of one level, each mirrored denoising: more are the same again."""
    bank = network("wiener-bank", regularisations=(1e-3,), align=False, rounds=3)
    bank.levels = (replace(bank.levels[-1], iterations=1),)
    bank.denoiser = build("drunet", widths=(4, 4, 8, 8), blocks=1).eval()
    export(bank, camera(), tmp_path / "camera.onnx", least=100)


def test_iterations_are_a_loop_in_the_file(tmp_path, generator):
    """A copy of the operations for each of 164 iterations took over nine minutes to export, for networks more.

    Networks with iterations are exported in the tests of `make acceptance`.
    """
    solver = build_solver("admm", iterations=3)
    file = export(solver, camera(), tmp_path / "camera.onnx", least=100).path
    operations = [node.op_type for node in onnx.load(str(file)).graph.node]
    assert operations.count("Loop") == 1
    captures = random_batch(generator, count=3)  # not the two of the export
    wanted = Reconstructor(solver, camera())(captures)
    assert agreement(run_file(file, captures), wanted) > 100


@pytest.mark.acceptance
@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver(name, tmp_path):
    """`admm` and `wiener` of a given regularisation are exported in other tests, too."""
    options = {"iterations": 5} if name == "fista" else {}  # the others are loops
    export(build_solver(name, **options), camera(), tmp_path / "camera.onnx", least=100)


@pytest.mark.parametrize(
    ("precision", "share"), [("float16", 2), pytest.param("int8", 4, marks=pytest.mark.acceptance)]
)
def test_lower_precisions(precision, share, tmp_path):
    """The first convolution and, with int8, the last one stay float32: a few thousand bytes of 350,000 numbers."""
    import onnx

    unet = network("unet", width=16)
    done = export(unet, camera(), tmp_path / "camera.onnx", precision=precision)
    assert MIN_AGREEMENT[precision] <= done.agreement < 100
    numbers = sum(parameter.numel() for parameter in unet.parameters())
    assert done.path.stat().st_size < 1.1 * 4 * numbers / share
    graph = onnx.load(done.path).graph
    assert {"float16": "Cast", "int8": "QuantizeLinear"}[precision] in {node.op_type for node in graph.node}
    assert read_about(done.path)["precision"] == precision


@pytest.mark.acceptance
@pytest.mark.parametrize("name", ["flatnet", "ifin", "svdeconv"])
def test_float16_of_group_norm_and_mixed_precisions(name, tmp_path):
    """From 16 features on convolutions are float16; what stands between them stays float32."""
    options = {"size": SIZE} if name == "svdeconv" else {}
    unet = network(name, width=16, **options)
    done = export(unet, camera(), tmp_path / "camera.onnx", precision="float16")
    assert MIN_AGREEMENT["float16"] <= done.agreement < 100


def test_torchs_own_format(tmp_path, generator):
    method = network("wiener")
    done = export(method, camera(), tmp_path / "camera.pt2")
    assert read_about(done.path) == done.about
    batch = random_batch(generator, 3)
    exact = Reconstructor(method, camera(), device="cpu", precision="exact")(batch)
    assert agreement(run_file(done.path, batch), exact) >= 100


def test_grey_captures(tmp_path):
    done = export(network("wiener"), camera(channels=1), tmp_path / "camera.onnx")
    assert run_file(done.path, torch.rand(1, 1, *SIZE)).shape == (1, 1, *SIZE)
    assert done.about["channels"] == "1"


class Cumulative(nn.Module):
    def forward(self, measurement, psf):
        return measurement.cumsum(-1)


class Careless(nn.Module):
    """Each of its copies is another function: what is exported differs from what it is compared with."""

    numbers = itertools.count(1)

    def __init__(self):
        super().__init__()
        self.number = next(self.numbers)

    def __deepcopy__(self, memo):
        return Careless()

    def forward(self, measurement, psf):
        return measurement * self.number


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (Cumulative(), r"`aten.cumsum.default` cannot be written as ONNX. Export to .pt2 instead."),
        (Careless(), r"must agree with `Careless` to 80.0 dB, but does to [-\d.]+ dB; it is not written"),
    ],
)
def test_a_file_that_is_not_the_same_function_is_not_written(method, message, tmp_path):
    out = tmp_path / "camera.onnx"
    with pytest.raises(ExportError, match=message):
        export(method, camera(), tmp_path / "new" / "camera.onnx")
    assert not any(tmp_path.iterdir())
    out.write_bytes(b"an older one")
    with pytest.raises(ExportError, match=message):
        export(method, camera(), out)
    assert [path.name for path in tmp_path.iterdir()] == ["camera.onnx"]
    assert out.read_bytes() == b"an older one"


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_a_file_that_onnxruntime_refuses_is_not_written(precision, tmp_path, monkeypatch):
    """Two types in one sum: the checker of onnx lets it pass."""
    half = {torch.ops.aten.relu.default: lambda g, node, x: g("Add", x, torch.ones(1, dtype=torch.float16))}
    monkeypatch.setattr("mwdn.export.onnx_program.REAL_HANDLERS", REAL_HANDLERS | half)
    with pytest.raises(ExportError, match=r"`camera.onnx` cannot be run: .*Add.* Export it again: as .onnx, as .pt2"):
        export(Rectified(), camera(), tmp_path / "camera.onnx", precision=precision)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
def test_a_foreign_file_is_not_run(suffix, tmp_path, caplog):
    """torch logged the traceback of its first attempt."""
    file = tmp_path / f"camera{suffix}"
    for content in (None, b"something else"):
        if content:
            file.write_bytes(content)
        with pytest.raises(ExportError, match=rf"`camera{suffix}` cannot be run: "):
            run_file(file, torch.rand(1, 3, *SIZE))
        with pytest.raises(ExportError, match=rf"`camera{suffix}` cannot be read: "):
            read_about(file)
    assert not caplog.records


def test_more_than_onnx_holds_is_an_error_of_mwdn():
    """protobuf's error, which `ByteSize` raises as well, ended the command with a traceback."""

    from google.protobuf.message import EncodeError

    class Large:
        graph = SimpleNamespace(initializer=[SimpleNamespace(raw_data=range(3 * 2**30))])

        def SerializeToString(self):  # noqa: N802
            raise EncodeError("Failed to serialize proto")

    with pytest.raises(ExportError, match=r"would have 3\.0 GB; ONNX files hold 2"):
        serialise(Large())


@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
def test_a_full_temporary_folder_is_named(suffix, tmp_path):
    """ONNX ended in a traceback, torch's writer in an abort of the process."""
    out = tmp_path / f"a{suffix}"
    with full_after(100), pytest.raises(ExportError, match=r"cannot be written to: File too large.*TMPDIR"):
        export(Unchanged(), camera(), out)
    assert not out.exists()


def test_options_of_an_object_are_refused(tmp_path):
    with pytest.raises(ParameterError, match="regularisation"):
        export(SOLVERS["wiener"](), camera(), tmp_path / "camera.pt2", regularisation=1e-3)


@pytest.mark.parametrize(
    ("out", "options", "message"),
    [
        ("camera.pt", {}, r"must end in .onnx or .pt2, not '.pt'"),
        ("camera.pt2", {"precision": "int8"}, r"`precision` int8 .*\.onnx"),
        ("camera.onnx", {"precision": "half"}, r"No precision named 'half'"),
        ("camera.onnx", {"least": "80"}, r"`least` \('80'\) .* must be a number"),
        ("camera.onnx", {"calibration": "psf.png"}, r"`calibration` \('psf.png'\) .* must be `Calibration`"),
        ("camera.onnx", {"channels": 2}, r"`channels` \(2\) must be 1 or 3"),
        ("camera.onnx", {"channels": 1}, r"`channels` \(1\) must be 3, because the PSF has colours"),
    ],
)
def test_wrong_calls(out, options, message, tmp_path):
    arguments = {"calibration": camera(), **options}
    with pytest.raises(ParameterError, match=message):
        export(network("wiener"), out=tmp_path / out, **arguments)


def test_a_network_of_another_camera_is_exported_with_a_warning(tmp_path):
    """As it is used by `Reconstructor`; the file was written without a word."""
    save_network(tmp_path / "best.safetensors", network("wiener"), "wiener", {}, psf_hash="0123456789abcdef")
    with pytest.warns(UserWarning, match="best.safetensors` was trained for PSF 0123456789abcdef"):
        done = export(tmp_path / "best.safetensors", camera(), tmp_path / "camera.pt2")
    assert done.about["method"] == "best.safetensors"  # packages are published: without the folders


def test_the_file_says_how_raw_frames_become_measurements(tmp_path):
    frames = FrameFormat(bgr=True, bit_depth=12, crop=(76, 96), bin=2, upside_down=True)
    taken = replace(camera(), frames=frames, dark=torch.zeros(1, 3, 2 * 40, 2 * 50))
    about = export(Unchanged(), taken, tmp_path / "camera.onnx").about
    assert (about["crop"], about["binning"], about["bit_depth"]) == ("76 x 96", "2", "12")
    assert "at the bottom" in about["rows"]
    assert "blue, green, red" in about["colours"]
    assert "subtracted" in about["dark"]
    assert not {"rows", "colours", "dark"} & set(export(Unchanged(), camera(), tmp_path / "b.onnx").about)


def test_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingPackageError, match=r"onnxruntime.*`pip install 'mwdn\[export\]'`"):
        export(network("wiener"), camera(), tmp_path / "camera.onnx")


def test_command(tmp_path, capsys):
    np.save(tmp_path / "psf.npy", camera().psf[0].movedim(0, -1).numpy())
    out = tmp_path / "camera.onnx"
    with pytest.raises(SystemExit) as ended:
        main(["export", "fista", "--psf", str(tmp_path / "psf.npy"), "--out", str(tmp_path / "camera.tar")])
    assert ended.value.code == 2
    with pytest.raises(SystemExit) as ended:
        main(["export", "wiener", "--regularisation", "1e-3", "--psf", str(tmp_path / "psf.npy"), "--out", str(out)])
    assert ended.value.code == 0
    assert "agrees to" in capsys.readouterr().out
    assert read_about(out)["method"] == "wiener"


@pytest.mark.parametrize("taken", ["--psf", "--dark"])
def test_the_command_does_not_replace_its_inputs(taken, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_frame(tmp_path / "psf.png", (camera().psf[0].movedim(0, -1) * 60000).numpy().round().astype(np.uint16))
    shutil.copy("psf.png", "camera.onnx")
    with pytest.raises(SystemExit) as ended:
        main(["export", "wiener", *(["--psf", "psf.png"] if taken != "--psf" else []), taken, "camera.onnx"])
    assert ended.value.code == 2
    assert "would overwrite an input" in capsys.readouterr().err
    assert Path("camera.onnx").read_bytes() == Path("psf.png").read_bytes()


@pytest.mark.parametrize("name", ["a.onnx", "a.pt2"])
def test_a_file_without_a_description_is_refused(tmp_path, name):
    with pytest.raises(ExportError, match=name):
        read_about(tmp_path / name)
    (tmp_path / name).write_text("hi")  # as ONNX this was a model without metadata
    with pytest.raises(ExportError, match=name):
        read_about(tmp_path / name)
