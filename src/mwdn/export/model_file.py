"""Exported files: write, run and describe them; ONNX or torch's ``.pt2``."""

import io
import json
import logging
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.export import ExportedProgram

from mwdn.arguments import check_batch
from mwdn.errors import ExportError
from mwdn.export.onnx_program import to_onnx
from mwdn.io.files import atomic
from mwdn.runtime.requirement import require
from mwdn.types import Measurement, Scene

if TYPE_CHECKING:
    import onnx

ABOUT = "mwdn.json"
"""Name of the description inside a ``.pt2`` file; an ONNX file holds it as its metadata."""


def require_onnx() -> None:
    """Raise a `MissingPackageError` unless onnx and onnxruntime are installed."""
    for module in ("onnx", "onnxruntime"):
        require(module, "export", purpose="ONNX")


def trace(module: nn.Module, arguments: tuple[Tensor, ...], name: str, **options: Any) -> ExportedProgram:  # noqa: ANN401
    """The program of a module, called ``name`` in the message, by `torch.export.export` with these ``options``.

    Raises:
        ExportError: torch cannot follow it.
    """
    try:
        return torch.export.export(module.eval(), arguments, **options)
    except (RuntimeError, ValueError, TypeError) as error:  # torch raises many kinds of errors
        raise ExportError(f"{name} cannot be exported: {str(error).strip().splitlines()[0]}") from error


def write_file(file: Path, program: ExportedProgram, about: dict[str, str]) -> None:
    """Write a program in the format of the file's suffix.

    Raises:
        ExportError: an operation has no ONNX form, or the file would exceed 2 GB, the maximum of ONNX; or the folder
            is full.
    """
    content = _pt2(program, about) if file.suffix == ".pt2" else _onnx(program, about)
    with temporary_files(file.parent):
        file.write_bytes(content)


@contextmanager
def temporary_files(folder: Path) -> Iterator[None]:
    """Turn an `OSError` while writing into a folder for temporary files into an `ExportError` that names it."""
    try:
        yield
    except OSError as error:
        raise ExportError(
            f"`{folder}` for temporary files cannot be written to: {error.strerror or error}. Make room, or name "
            "another folder: `export TMPDIR=/PATH`."
        ) from error


def _pt2(program: ExportedProgram, about: dict[str, str]) -> bytes:
    content = io.BytesIO()  # torch's own writer ends the process with an abort when the disk is full
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about channels-last weights
        torch.export.save(program, content, extra_files={ABOUT: json.dumps(about)})
    return content.getvalue()


def _onnx(program: ExportedProgram, about: dict[str, str]) -> bytes:
    import onnx

    model = to_onnx(program)
    onnx.helper.set_model_props(model, about)
    model.producer_name, model.producer_version = "mwdn", about["version"]
    return serialise(model)


def serialise(model: "onnx.ModelProto") -> bytes:
    """The content of an ONNX file, checked.

    Raises:
        ExportError: it would exceed 2 GB, the maximum of ONNX.
    """
    import onnx

    try:
        content = model.SerializeToString()
    except Exception as error:  # EncodeError or ValueError, by protobuf's version; `ByteSize` raises it, too
        size = sum(len(constant.raw_data) for constant in model.graph.initializer) / 2**30
        raise ExportError(
            f"The file would have {size:.1f} GB; ONNX files hold 2. Export to .pt2, or `--bin 2`."
        ) from error
    onnx.checker.check_model(content)
    return content


def run_file(file: str | Path, measurement: Measurement) -> Scene:
    """Reconstruct a batch with an exported file, on the CPU.

    Args:
        file: .pt2 or .onnx.
        measurement: (B, C, H, W), of the size and channels of the file.

    Raises:
        MissingPackageError: onnxruntime is not installed.
        ShapeError: the measurement is no batch.
        ParameterError: the measurement holds integers, or is no tensor.
        ExportError: the file cannot be read or run.
    """
    file = Path(file)
    check_batch(measurement, "measurement")
    measurement = measurement.detach().cpu().float()
    if file.suffix == ".pt2":
        with as_export_error(file), torch.no_grad():
            return _load_pt2(file).module()(measurement)
    onnxruntime = require("onnxruntime", "export", purpose="ONNX")
    with as_export_error(file):
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        return torch.from_numpy(session.run(["scene"], {"measurement": measurement.numpy()})[0])


def read_about(file: str | Path) -> dict[str, str]:
    """The description that `export` stored in a file: method, version, PSF, size and units, each as text.

    Args:
        file: .pt2 or .onnx.

    Raises:
        MissingPackageError: onnx is not installed.
        ExportError: the file cannot be read, or `export` did not write it.
    """
    file = Path(file)
    if file.suffix == ".pt2":
        extra = {ABOUT: ""}
        with as_export_error(file, "read"):
            _load_pt2(file, extra)
            return json.loads(extra[ABOUT])
    onnx = require("onnx", "export", purpose="ONNX")
    with as_export_error(file, "read"):
        about = {entry.key: entry.value for entry in onnx.load(str(file)).metadata_props}
        if "method" not in about:  # onnx takes any text for a model
            raise ValueError("it has no description")
        return about


def _load_pt2(file: Path, extra: dict[str, str] | None = None) -> ExportedProgram:
    log = logging.getLogger(torch.export.__name__)
    log.disabled = True  # torch prints the traceback of an error that it then raises in other words
    try:
        return torch.export.load(file, extra_files=extra)
    finally:
        log.disabled = False


def publish(file: Path, out: Path) -> None:
    """Copy a finished file to its place, atomically.

    Raises:
        ExportError: the place cannot be written to.
    """
    try:
        with atomic(out) as temporary:
            shutil.copyfile(file, temporary)
    except OSError as error:
        raise ExportError(f"`{out}` cannot be written: {error.strerror or error}. Choose another folder.") from error


@contextmanager
def as_export_error(file: Path, use: str = "run") -> Iterator[None]:
    """Turn the many kinds of errors of onnxruntime and torch into an `ExportError`."""
    try:
        yield
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        advice = "Export it again: as .onnx, as .pt2, or with another `--precision`."
        raise ExportError(f"`{file.name}` cannot be {use}: {reason.rstrip('.')}. {advice}") from error
