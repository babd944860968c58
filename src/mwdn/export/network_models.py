"""A network as two ONNX models: one prepares a PSF, the other reconstructs with the prepared tensors.

Together they serve every camera of one picture size: the PSF is an input, as in `mwdn.networks.network.Network`.
"""

import copy
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils._pytree import TreeSpec, tree_flatten, tree_unflatten

from mwdn.export.model_file import as_export_error, require_onnx, serialise, trace
from mwdn.export.onnx_program import to_onnx
from mwdn.inference.fusion import fuse
from mwdn.networks.network import Network, as_network
from mwdn.runtime.requirement import require
from mwdn.types import Measurement, Psf, Scene, Size, size_of


class NetworkModels(NamedTuple):
    """Contents of two ONNX files.

    Args:
        prepare: from ``psf`` (1, C, H, W), each channel of unit sum, to ``prepared_0``, ``prepared_1`` ...: transfer
            functions, whose real and imaginary parts are two outputs, and other tensors.
        reconstruct: from ``measurement`` (1, C, H, W) and the outputs of ``prepare`` to ``scene`` (1, C, H, W).
    """

    prepare: bytes
    reconstruct: bytes


class _Prepare(nn.Module):
    def __init__(self, network: Network[Any]) -> None:
        super().__init__()
        self.network = network

    def forward(self, psf: Psf) -> tuple[Tensor, ...]:
        tensors, _ = tree_flatten(self.network.prepare(psf, size_of(psf)))
        return tuple(_parts(tensors))


class _Reconstruct(nn.Module):
    """Takes the parts of complex tensors as separate tensors, since ONNX has no complex numbers."""

    def __init__(self, network: Network[Any], is_complex: list[bool], layout: TreeSpec) -> None:
        super().__init__()
        self.network = as_network(fuse(network, None, pack=False))
        self.is_complex, self.layout = is_complex, layout

    def forward(self, measurement: Measurement, *prepared: Tensor) -> Scene:
        parts = iter(prepared)
        tensors = [torch.complex(next(parts), next(parts)) if both else next(parts) for both in self.is_complex]
        scene = self.network.reconstruct(measurement, tree_unflatten(tensors, self.layout)).float()
        return self.network.as_recorded(scene)


def network_models(network: Network[Any], size: Size, channels: int) -> NetworkModels:
    """Export a network for pictures of one size, one at a time.

    Args:
        network: in evaluation mode; it is not changed.
        size: height and width of PSF and measurement.
        channels: of both, 1 or 3.

    Raises:
        MissingPackageError: onnx or onnxruntime is not installed.
        ExportError: an operation has no ONNX form.
    """
    require_onnx()
    network = copy.deepcopy(network).cpu().eval().requires_grad_(False)
    psf = torch.full((1, channels, *size), 1 / (size[0] * size[1]))
    with torch.no_grad():
        tensors, layout = tree_flatten(network.prepare(psf, size))
        parts = list(_parts(tensors))
        names = [f"prepared_{index}" for index in range(len(parts))]
        prepare = _model(_Prepare(network), (psf,), names)
        second = _Reconstruct(network, [tensor.is_complex() for tensor in tensors], layout)
        return NetworkModels(prepare, _model(second, (psf, *parts), ["scene"]))


def run_models(models: NetworkModels, psf: Psf, measurements: Measurement) -> Scene:
    """Reconstruct measurements (B, C, H, W) one by one in onnxruntime, on the CPU.

    Raises:
        ExportError: the models cannot be run.
    """
    onnxruntime = require("onnxruntime", "export", purpose="ONNX")
    providers = ["CPUExecutionProvider"]
    with as_export_error(Path("network.onnx")):
        prepare, reconstruct = (onnxruntime.InferenceSession(model, providers=providers) for model in models)
        names = [output.name for output in prepare.get_outputs()]
        prepared = dict(zip(names, prepare.run(names, {"psf": psf.numpy()}), strict=True))
        scenes = [reconstruct.run(["scene"], {"measurement": m.numpy(), **prepared})[0] for m in measurements[:, None]]
    return torch.cat([torch.from_numpy(scene) for scene in scenes])


def _parts(tensors: list[Tensor]) -> Iterator[Tensor]:
    for tensor in tensors:
        yield from (tensor.real, tensor.imag) if tensor.is_complex() else (tensor,)


def _model(module: nn.Module, arguments: tuple[Tensor, ...], outputs: list[str]) -> bytes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about constants that it copies
        program = trace(module, arguments, "The network")
    return serialise(to_onnx(program, outputs))
