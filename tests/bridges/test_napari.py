"""The napari plugin: its manifest by npe2, its reader, and its widget in a viewer without a display."""

import os
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import mwdn
from mwdn import Camera, read_frame
from mwdn.bridges import napari as plugin
from mwdn.errors import MissingPackageError, ParameterError
from mwdn.io.images import write_frame
from mwdn.optics import sample_camera

SIZE = (32, 40)


@pytest.fixture
def folder(tmp_path, generator):
    """A PSF and a capture through it, 16 bits."""
    psf = sample_camera(11, SIZE).expand(1, 3, -1, -1)
    scene = torch.zeros(1, 3, *SIZE)
    scene[..., 10:20, 12:24] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
    for name, image in (("psf", psf), ("capture", Camera(psf)(scene))):
        frame = (image / image.max() * 60000)[0].movedim(0, -1).numpy().astype(np.uint16)
        write_frame(tmp_path / f"{name}.png", np.ascontiguousarray(frame))
    return tmp_path


def test_captures_are_layers_of_their_numbers(folder):
    path = str(folder / "capture.png")
    ((data, options, kind),) = plugin.get_reader(path)(path)
    np.testing.assert_array_equal(data, read_frame(path))
    assert (options, kind) == ({"name": "capture", "rgb": True}, "image")
    assert len(plugin.get_reader([path, path])([path, path])) == 2
    assert plugin.get_reader("notes.txt") is None


def test_a_camera_file_is_a_layer_of_its_psf(folder):
    (folder / "camera.toml").write_text('psf = "psf.png"\nbin = 2\n')
    path = str(folder / "camera.toml")
    ((data, options, _),) = plugin.get_reader(path)(path)
    expected = mwdn.Calibration.load(path).psf[0].movedim(0, -1).numpy()
    np.testing.assert_allclose(data, expected / expected.max())
    assert options["name"] == "camera PSF"


def test_a_reconstruction_is_a_layer_with_its_linear_numbers(folder):
    frame = read_frame(folder / "capture.png")
    data, options, kind = plugin.reconstruct_layer(frame, folder / "psf.png", "wiener", "capture")
    expected = mwdn.Reconstructor("wiener", mwdn.Calibration.from_file(folder / "psf.png"))(frame)
    np.testing.assert_array_equal(options["metadata"]["mwdn"]["scene"], expected)
    assert (data.shape, options["name"], kind) == ((*SIZE, 3), "capture, wiener", "image")
    assert 0 <= data.min() <= data.max() <= 1


def test_without_napari_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "magicgui", None)
    with pytest.raises(MissingPackageError, match=r"mwdn\[napari\]"):
        plugin.reconstruct_widget()


def test_npe2_accepts_the_manifest():
    npe2 = pytest.importorskip("npe2", reason="the extra `napari` is not installed")
    manifest = npe2.PluginManifest.from_file(Path(plugin.__file__).with_name("napari.yaml"))
    manifest.validate_imports()
    (reader,) = manifest.contributions.readers
    assert {pattern.removeprefix("*") for pattern in reader.filename_patterns} == plugin.SUFFIXES


def test_pairs_are_stacks_that_are_read_when_shown(tmp_path):
    pytest.importorskip("dask.array", reason="the extra `napari` is not installed")
    pixels = np.random.default_rng(0).integers(0, 256, (2, 3, 5, 6, 3), np.uint8)
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        file["measurement"], file["scene"] = pixels
    path = str(tmp_path / "pairs.h5")
    layers = plugin.get_reader(path)(path)
    assert [options["name"] for _, options, _ in layers] == ["pairs measurement", "pairs scene"]
    for (data, _, _), numbers in zip(layers, pixels, strict=True):
        np.testing.assert_allclose(np.asarray(data), numbers / 255, atol=1e-6)


@pytest.mark.filterwarnings("ignore")  # of napari and Qt
def test_the_widget_makes_a_layer_of_the_picture_that_is_shown(folder, request, monkeypatch):
    """In a viewer without its canvas, which needs OpenGL."""
    napari = pytest.importorskip("napari", reason="the extra `napari` is not installed")
    pytest.importorskip("pytestqt", reason="pytest-qt is not installed")
    from napari.components import ViewerModel

    qtbot, viewer = request.getfixturevalue("qtbot"), ViewerModel()
    monkeypatch.setattr(napari, "current_viewer", lambda: viewer)
    frame = read_frame(folder / "capture.png")
    stack = viewer.add_image(np.stack([np.zeros_like(frame), frame]), name="captures", rgb=True)
    viewer.dims.set_current_step(0, 1)
    widget = plugin.reconstruct_widget()
    with pytest.raises(ParameterError, match="camera file"):
        widget(capture=stack, psf=Path("nothing"))
    layers = []
    worker = widget(capture=stack, psf=folder / "psf.png", method="wiener")
    worker.returned.connect(layers.append)
    qtbot.waitUntil(lambda: bool(layers), timeout=60_000)
    layer = napari.layers.Layer.create(*layers[0])
    assert (layer.name, layer.rgb) == ("captures, wiener", True)
    expected, *_ = plugin.reconstruct_layer(frame, folder / "psf.png", "wiener", "captures")
    np.testing.assert_allclose(layer.data, expected, atol=1e-5)
