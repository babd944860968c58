"""Packages for bioimage.io: their content here, and the test of bioimageio.core where it is installed.

An export takes four seconds of processor time, most of it torch's tracing: acceptance tests.
"""

import re
import zipfile

import numpy as np
import pytest
import torch
import yaml
from torch import nn

pytest.importorskip("onnxruntime", reason="the extra `export` is not installed")

from full_disk import full_after
from mwdn import Calibration, Camera, Reconstructor
from mwdn.errors import ExportError, ParameterError
from mwdn.optics import sample_camera

SIZE = (24, 32)


@pytest.fixture(scope="module")
def calibration():
    return Calibration(sample_camera(11, SIZE).expand(1, 3, -1, -1).contiguous())


@pytest.fixture(scope="module")
def package(calibration, tmp_path_factory):
    from mwdn.bridges import export_bioimage

    out = tmp_path_factory.mktemp("bioimage") / "camera.zip"
    assert export_bioimage("wiener", calibration, out, regularisation=1e-3).agreement > 80
    return out


@pytest.mark.acceptance
def test_the_description_names_what_is_in_the_package(package, calibration):
    with zipfile.ZipFile(package) as archive:
        description = yaml.safe_load(archive.read("rdf.yaml"))
        tensors = [*description["inputs"], *description["outputs"]]
        files = [tensor["test_tensor"] for tensor in tensors] + [description["weights"]["onnx"]]
        assert {file["source"] for file in files} | {"rdf.yaml", "README.md"} == set(archive.namelist())
    assert [tensor["id"] for tensor in tensors] == ["measurement", "scene"]
    assert [axis.get("size") for axis in tensors[0]["axes"]] == [None, None, *SIZE]
    assert calibration.psf_hash in description["name"]


@pytest.mark.acceptance
def test_the_test_tensors_are_a_capture_and_its_reconstruction(package, calibration):
    with zipfile.ZipFile(package) as archive:
        measurement, scene = (np.load(archive.open(f"{name}.npy")) for name in ("measurement", "scene"))
    expected = Reconstructor("wiener", calibration, device="cpu", regularisation=1e-3)(torch.from_numpy(measurement))
    np.testing.assert_allclose(scene, expected.numpy(), atol=1e-4)
    seen = Camera(calibration.psf)(torch.from_numpy(scene)).numpy()
    assert np.corrcoef(seen.ravel(), measurement.ravel())[0, 1] > 0.9


@pytest.mark.acceptance
def test_the_command_writes_it(run, calibration, tmp_path):
    np.save(tmp_path / "psf.npy", calibration.psf[0].movedim(0, -1).numpy())
    out = tmp_path / "camera.zip"
    code, _, error = run("export", "wiener", "--psf", tmp_path / "psf.npy", "--out", out, "--regularisation", "1e-3")
    assert code == 0, error
    assert zipfile.is_zipfile(out)


def test_another_suffix_is_refused(calibration, tmp_path):
    from mwdn.bridges import export_bioimage

    with pytest.raises(ParameterError, match=r"\.zip"):
        export_bioimage("wiener", calibration, tmp_path / "camera.onnx")


class Unchanged(nn.Module):
    """The quickest to export."""

    def forward(self, measurement, psf):
        return measurement * 1.0


def test_a_full_temporary_folder_is_named(calibration, tmp_path):
    """The test tensors and the zip ended in a traceback."""
    from mwdn.bridges import export_bioimage

    out = tmp_path / "camera.zip"
    out.write_bytes(b"an older one")
    for size in (8000, 16000):  # the ONNX has 2 kB, each tensor 9 kB, the zip 18 kB
        with full_after(size), pytest.raises(ExportError, match=r"cannot be written to: .*TMPDIR"):
            export_bioimage(Unchanged(), calibration, out)
    assert out.read_bytes() == b"an older one"


def test_the_name_is_one_that_the_format_allows(calibration, tmp_path):
    """At most 128 characters, letters without accents."""
    from mwdn.bridges import export_bioimage

    method = type("Größe" * 40, (Unchanged,), {})()
    export_bioimage(method, calibration, tmp_path / "camera.zip")
    with zipfile.ZipFile(tmp_path / "camera.zip") as archive:
        name = yaml.safe_load(archive.read("rdf.yaml"))["name"]
    assert re.fullmatch(r"[A-Za-z0-9_+ ()-]{5,128}", name)
    assert name.endswith(calibration.psf_hash)


@pytest.mark.acceptance
@pytest.mark.filterwarnings("ignore")  # it leaves the package open
def test_bioimageio_reproduces_the_reconstruction(package):
    """The format, the ONNX against the test tensors, and batches of two; nothing is fetched."""
    core = pytest.importorskip("bioimageio.core", reason="the extra `bioimage` is not installed")
    summary = core.test_model(package)
    assert summary.status == "passed", summary.format()
