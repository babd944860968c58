"""The ONNX of one camera as a package of bioimage.io: ``rdf.yaml``, weights, test tensors, documentation, as a zip."""

import json
import re
import tempfile
import zipfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.arguments import checked
from mwdn.calibration import Calibration
from mwdn.errors import ParameterError
from mwdn.export.exporter import Exported, Precision, export, simulate_captures
from mwdn.export.model_file import publish, run_file, temporary_files
from mwdn.inference.methods import Method
from mwdn.io.files import file_sha256, refuse_overwrite
from mwdn.types import Image

FORMAT = "0.5.3"
"""Version of the format, of December 2024; programs of later ones read it."""

_PAPER = (
    "Y. Li, Z. Li, K. Chen, Y. Guo, C. Rao: MWDNs: reconstruction in multi-scale feature spaces for lensless imaging"
)


@checked
def export_bioimage(
    method: Method | str | Path,
    calibration: Calibration,
    out: str | Path,
    *,
    precision: Precision = "float32",
    channels: int | None = None,
    least: float | None = None,
    **options: Any,  # noqa: ANN401
) -> Exported:
    """Write a method for one camera as a package of bioimage.io, after the checks of `mwdn.export.export`.

    The test tensors are a simulated capture through the camera's PSF, and its reconstruction by the ONNX.

    Args:
        method: as for `mwdn.export.export`, as are the other arguments.
        calibration: of the camera.
        out: ends in ``.zip``; an existing file is replaced only on success.
        precision: of the convolutions.
        channels: of the captures; those of the PSF unless given.
        least: minimum agreement in dB.
        **options: of a solver given by its name.

    Raises:
        ParameterError: another suffix, and as for `mwdn.export.export`.
        MwdnError: as for `mwdn.export.export`.
    """
    out = Path(out)
    if out.suffix != ".zip":
        raise ParameterError(f"`{out}` must end in .zip, not '{out.suffix}': a package of bioimage.io is a zip file.")
    refuse_overwrite(out)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        weights = folder / "weights.onnx"
        exported = export(method, calibration, weights, precision=precision, channels=channels, least=least, **options)
        measurement = simulate_captures(calibration, ("astronaut",), channels or calibration.psf.shape[1])[:1]
        scene = run_file(weights, measurement)
        rows = "\n".join(f"| {name} | {value} |" for name, value in exported.about.items())
        with temporary_files(folder):
            np.save(folder / "measurement.npy", measurement.numpy())
            np.save(folder / "scene.npy", scene.numpy())
            documentation = _TEXT.format(rows=rows, agreement=exported.agreement)
            (folder / "README.md").write_text(documentation, encoding="utf-8")
            description = json.dumps(_description(exported, folder, measurement, scene), indent=2, ensure_ascii=False)
            (folder / "rdf.yaml").write_text(description, encoding="utf-8")  # JSON is YAML
            package = folder / "package.zip"
            with zipfile.ZipFile(package, "w", zipfile.ZIP_DEFLATED) as archive:
                for name in ("rdf.yaml", "README.md", "measurement.npy", "scene.npy", "weights.onnx"):
                    archive.write(folder / name, name)
        publish(package, out)
    return Exported(out, exported.agreement, exported.about)


def _description(exported: Exported, folder: Path, measurement: Image, scene: Image) -> dict[str, Any]:
    """Content of ``rdf.yaml``."""
    import onnx

    opset = max(each.version for each in onnx.load(exported.path, load_external_data=False).opset_import)
    about = exported.about
    title = f"mwdn {Path(about['method']).stem[:96]} for PSF {about['psf_hash']}"  # 128 characters at most
    name = re.sub(r"[^\w -]", "-", title, flags=re.ASCII)
    file = {"source": "weights.onnx", "sha256": file_sha256(exported.path)}
    return {
        "type": "model",
        "format_version": FORMAT,
        "name": name,
        "description": f"Reconstruction of the captures of one lensless camera, {about['size']} pixels.",
        "authors": [{"name": "The mwdn developers"}],
        "cite": [{"text": _PAPER, "doi": "10.1364/OE.501970"}],
        "license": "MIT",
        "documentation": {"source": "README.md"},
        "tags": ["lensless-imaging", "deconvolution", "image-reconstruction"],
        "timestamp": datetime.now(UTC).isoformat(timespec="seconds"),
        "inputs": [_tensor("measurement", measurement, folder, about["measurement"])],
        "outputs": [_tensor("scene", scene, folder, about["scene"])],
        "weights": {"onnx": {**file, "opset_version": opset}},
        "config": {"mwdn": about},
    }


def _tensor(name: str, image: Image, folder: Path, description: str) -> dict[str, Any]:
    channels = ["red", "green", "blue"] if image.shape[1] == 3 else ["light"]
    axes: list[dict[str, Any]] = [{"type": "batch"}, {"type": "channel", "channel_names": channels}]
    axes += [{"type": "space", "id": axis, "size": size} for axis, size in zip("yx", image.shape[2:], strict=True)]
    file = folder / f"{name}.npy"
    return {
        "id": name,
        "description": description[:128],
        "axes": axes,
        "data": {"type": "float32"},
        "test_tensor": {"source": file.name, "sha256": file_sha256(file)},
    }


_TEXT = """# Reconstruction for one lensless camera

This file turns captures of one lensless camera into pictures. Its PSF and its picture size are fixed in the file: for
another camera, or after the mask was touched, export again with `mwdn export`.

| | |
| --- | --- |
{rows}

## Validation

The ONNX agrees with the package that wrote it to {agreement:.1f} dB PSNR on simulated captures. `measurement.npy` is
one of them, `scene.npy` its reconstruction. Detail below the noise of a capture is guessed, and a wrong PSF gives a
wrong picture.
"""
