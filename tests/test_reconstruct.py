"""Captures found, outputs planned, and a method bound to one camera."""

import inspect
import re

import cv2
import numpy as np
import pytest
import torch

from mwdn import Camera, read_frame
from mwdn.calibration import Calibration
from mwdn.data.images import srgb_decode
from mwdn.data.sheets import for_people
from mwdn.errors import CheckpointError, ImageError, ParameterError, ShapeError, UnknownNameError
from mwdn.learning import save_network
from mwdn.networks import NETWORKS, build
from mwdn.optics.patterns import contour_psf
from mwdn.reconstruct import Reconstructor, find_method, plan_outputs, reconstruct_file
from mwdn.solvers import SOLVERS, Admm, Wiener

SIZE = 32, 40


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()


@pytest.fixture
def measurement(psf, generator):
    scene = torch.zeros(1, 3, *SIZE)
    scene[..., 10:20, 12:22] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
    return Camera(psf).simulate(scene, generator=generator)


def touch(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return [folder / name for name in names]


# --- Files --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "suffix"), [("png", ".png"), ("png16", ".png"), ("tiff", ".tif"), ("npy", ".npy")])
def test_outputs_have_the_captures_names(tmp_path, form, suffix):
    captures = touch(tmp_path / "in", "a.tif", "b.c.npy")
    out = tmp_path / "out"
    assert plan_outputs(captures, out, form) == [out / f"a{suffix}", out / f"b.c{suffix}"]
    assert not out.exists()


def test_two_captures_of_one_name(tmp_path):
    one, two = touch(tmp_path, "a.tif", "a.png")
    message = f"`{two}` and `{one}` would both be written to `{tmp_path / 'out' / 'a.png'}`"
    with pytest.raises(ParameterError, match=re.escape(message)):
        plan_outputs([one, two], tmp_path / "out", "png")


def test_capture_called_summary(tmp_path):
    captures = touch(tmp_path, "summary.tif")
    with pytest.raises(ParameterError, match=r"summary\.tif` and the summary picture would both be written"):
        plan_outputs(captures, tmp_path / "out", "png")
    assert plan_outputs(captures, tmp_path / "out", "tiff") == [tmp_path / "out" / "summary.tif"]


@pytest.mark.parametrize("taken", ["a.png", "psf.png", "summary.png"])
def test_no_input_is_overwritten(tmp_path, taken):
    captures = touch(tmp_path, "a.png")
    captures += touch(tmp_path / "other", "psf.tif") if taken == "psf.png" else []
    psf = touch(tmp_path, taken)[0]
    out = tmp_path / "other" / ".."  # another spelling of the same folder
    (tmp_path / "other").mkdir(exist_ok=True)
    captures = captures if taken == "a.png" else [tmp_path / "other" / "x.png", *captures[1:]]
    with pytest.raises(ParameterError, match=rf"{taken}` would overwrite an input\. Choose another folder: `--out`"):
        plan_outputs(captures, out, "png", protected=(psf, None))


def test_out_is_a_file(tmp_path):
    file, capture = touch(tmp_path, "out", "a.png")
    with pytest.raises(ParameterError, match=r"`.*out` must be a folder, but is a file"):
        plan_outputs([capture], file, "png")


# --- Method -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOLVERS)
def test_each_solver_by_its_name(name, psf, measurement):
    result = Reconstructor(name, Calibration(psf), device="cpu")(measurement)
    assert result.shape == measurement.shape
    assert result.device.type == "cpu"
    torch.testing.assert_close(result, SOLVERS[name]()(measurement, psf))


def test_solver_object_and_function(psf, measurement):
    calibration = Calibration(psf)
    fixed = Wiener(regularisation=1e-3)
    assert torch.equal(Reconstructor(fixed, calibration)(measurement), fixed(measurement, psf))
    assert torch.equal(Reconstructor(lambda b, h: b - h, calibration)(measurement), measurement - psf)


@pytest.mark.parametrize("name", NETWORKS)
def test_each_network_from_its_checkpoint(tmp_path, name, psf, measurement):
    options = {"width": 2} if "width" in inspect.signature(NETWORKS[name]).parameters else {}
    network = build(name, **options)
    path = tmp_path / "net.safetensors"
    save_network(path, network, name, options)
    batch = torch.cat([measurement, measurement / 2])
    expected = network.eval()(batch, psf).detach()
    for method in (path, str(path), network.train()):
        result = Reconstructor(method, Calibration(psf), device="cpu")(batch)
        assert (result - expected).norm() < 0.05 * expected.norm()
        exact = Reconstructor(method, Calibration(psf), device="cpu", precision="exact")(batch)
        torch.testing.assert_close(exact, expected, rtol=1e-4, atol=1e-4)
        assert not result.requires_grad


def test_file_called_like_a_solver_does_not_hide_it(tmp_path, monkeypatch):
    touch(tmp_path, "admm")
    monkeypatch.chdir(tmp_path)
    assert isinstance(find_method("admm"), Admm)


def test_unknown_method():
    with pytest.raises(UnknownNameError, match=r"No method named 'admn'\. Did you mean 'admm'\? Known: .*wiener"):
        find_method("admn")
    with pytest.raises(CheckpointError, match=r"No checkpoint at `no\.safetensors`"):
        find_method("no.safetensors")


@pytest.mark.parametrize("device", ["gpu", "cpux", "cuda:99"])
def test_unusable_device(device, psf):
    with pytest.raises(ParameterError, match=rf"`device` \({device}\) must be one that torch can use here") as caught:
        Reconstructor("wiener", Calibration(psf), device=device)
    assert "\n" not in str(caught.value)


def test_measurement_of_another_size(psf):
    message = "`measurement` (1, 3, 16, 40) and `psf` (1, 3, 32, 40) must have the same height and width. Pass raw"
    with pytest.raises(ShapeError, match=re.escape(message)):
        Reconstructor("wiener", Calibration(psf))(torch.rand(1, 3, 16, 40))


@pytest.mark.parametrize(
    "error", [torch.OutOfMemoryError("CUDA out of memory"), RuntimeError("DefaultCPUAllocator: can't allocate memory")]
)
def test_too_large_for_the_memory(psf, measurement, error):
    def greedy(measurement, psf):
        raise error

    with pytest.raises(ParameterError, match=r"needs more memory than cpu has free\. Bin or crop it: `--bin 2`"):
        Reconstructor(greedy, Calibration(psf), device="cpu")(measurement)


@pytest.mark.parametrize("name", ["unet", "mwdn", "mwdn-cpsf"])
def test_network_of_other_colours(name, psf):
    with pytest.raises(ShapeError, match=r"must have 3 channels for this network"):
        Reconstructor(build(name, width=2), Calibration(psf[:, :1]))(torch.rand(1, 1, *SIZE))


# --- What is written ----------------------------------------------------------------------------------


@pytest.fixture
def capture(tmp_path, measurement):
    frame = (measurement[0].movedim(0, -1).clamp(0, 1) * 65535).round().numpy().astype(np.uint16)
    cv2.imwrite(str(tmp_path / "capture.png"), frame[..., ::-1])
    return tmp_path / "capture.png"


@pytest.mark.parametrize(("form", "suffix"), [("tiff", ".tif"), ("npy", ".npy")])
def test_linear_formats_hold_what_the_reconstructor_returns(tmp_path, form, suffix, capture, psf):
    reconstruct = Reconstructor("admm", Calibration(psf))
    output = tmp_path / "out" / f"capture{suffix}"
    b, scene = reconstruct_file(reconstruct, capture, output, form)
    assert torch.equal(b, reconstruct.calibration.correct(read_frame(capture)))
    assert torch.equal(scene, reconstruct(b))
    found = read_frame(output)
    assert found.dtype == np.float32
    assert np.array_equal(found, scene[0].movedim(0, -1).numpy())


@pytest.mark.parametrize(("form", "steps"), [("png", 255), ("png16", 65535)])
def test_png_is_the_same_picture_in_srgb(tmp_path, form, steps, capture, psf):
    output = tmp_path / "out.png"
    _, scene = reconstruct_file(Reconstructor("wiener", Calibration(psf)), capture, output, form)
    stored = read_frame(output)
    assert np.iinfo(stored.dtype).max == steps
    light = srgb_decode(torch.from_numpy(stored.astype(np.float32) / steps))
    # Half a step of the code is at most 2.275 / 1.055 ... of it in light: the steepest part is at white.
    torch.testing.assert_close(light, for_people(scene)[0].movedim(0, -1), rtol=0, atol=0.5 * 2.3 / steps + 1e-6)


def test_captures_are_read_as_the_calibration_says(tmp_path, psf, measurement):
    """Blue first and the last row first in the file: the same picture as from a plain file."""
    frame = measurement[0].movedim(0, -1).clamp(0, 1).numpy()
    np.save(tmp_path / "plain.npy", frame)
    np.save(tmp_path / "twisted.npy", frame[::-1, :, ::-1])
    plain = Reconstructor("wiener", Calibration(psf))
    twisted = Reconstructor("wiener", Calibration(psf, bgr=True, upside_down=True))
    one, two = (
        reconstruct_file(method, tmp_path / f"{name}.npy", tmp_path / f"{name}.tif", "tiff")
        for method, name in ((plain, "plain"), (twisted, "twisted"))
    )
    assert torch.equal(one[0], two[0])
    assert torch.equal(one[1], two[1])


def test_nothing_is_written_of_a_bad_capture(tmp_path, psf):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(ImageError, match=r"bad\.png"):
        reconstruct_file(Reconstructor("wiener", Calibration(psf)), tmp_path / "bad.png", tmp_path / "o.png", "png")
    assert not (tmp_path / "o.png").exists()
