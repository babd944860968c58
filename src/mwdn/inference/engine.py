"""A network bound to one PSF and one device: whatever does not depend on the measurement is computed once."""

import copy
from typing import Generic, Literal, cast, get_args

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.inference.cuda_graph import CudaGraph
from mwdn.inference.fusion import fuse
from mwdn.networks.network import Network, Prepared
from mwdn.runtime.devices import has_bfloat16, without_tf32
from mwdn.types import Measurement, Psf, Scene

Precision = Literal["fast", "exact"]
"""How a network computes. Fourier transforms are float32 in both.

- ``fast``: convolutions in half precision where the hardware has it (bfloat16 on a CPU, float16 on a GPU), else as
  ``exact``. Trained networks differ from it by 50 dB PSNR or more, their brightest pixel taken as 1 (``universal`` on
  real captures: 72 to 80 dB); one that amplifies rounding, such as a hardly trained MWDN-CPSF, by as little as 40 dB.
- ``exact``: float32, the network's own result but for the order of additions.
"""


class Engine(Generic[Prepared]):
    """A network bound to one PSF: a function of the measurement alone, as fast as the machine allows.

    BatchNorm is fused into the convolutions, which take channels-last features. The PSF is prepared once, in float32.
    On a GPU the calculation for each shape of a batch is recorded at its second call and replayed from then on.

    Memory is bounded: the U-Net's convolutions take a large picture a strip of rows at a time, see
    `mwdn.inference.tiling`; `mwdn.Reconstructor` takes a large batch a few pictures at a time.

    Args:
        network: as trained; a copy is taken.
        psf: (1 or B, C, H, W), of the camera.
        precision: see `Precision`.

    Raises:
        ParameterError: unknown precision.
    """

    def __init__(self, network: Network[Prepared], psf: Psf, *, precision: Precision = "fast") -> None:
        if precision not in get_args(Precision):
            raise ParameterError(f"`precision` must be fast or exact, not {precision!r}.")
        self.precision = precision
        exact = copy.deepcopy(network).to(psf.device).eval().requires_grad_(False)
        half = half_precision(psf.device) if precision == "fast" else None
        self.network = cast(Network[Prepared], fuse(copy.deepcopy(exact), half))
        # Prepares the PSF: spectra and regularisation need float32.
        self.exact = self.network if half is None else cast(Network[Prepared], fuse(exact, None))
        self._bind(psf)

    def _bind(self, psf: Psf) -> None:
        self.psf = psf
        self.prepared: Prepared | None = None
        self.graphs: dict[torch.Size, CudaGraph | None] = {}

    def with_psf(self, psf: Psf) -> "Engine[Prepared]":
        """The same network, sharing its weights, bound to another PSF."""
        other = copy.copy(self)
        other._bind(psf)
        return other

    @torch.inference_mode()
    def __call__(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch, (B, C, H, W), on the device of the PSF."""
        if measurement.device.type != "cuda":
            return self._reconstruct(measurement)
        # CUDA streams belong to the current device. Without TF32, what stays float32 keeps its 23 bits.
        with torch.cuda.device(measurement.device), without_tf32():
            return self._replay(measurement)

    def _replay(self, measurement: Tensor) -> Tensor:
        if measurement.shape not in self.graphs:
            if len(self.graphs) >= 4:  # each holds the memory of a whole reconstruction
                self.graphs.clear()
            self.graphs[measurement.shape] = None
            return self._reconstruct(measurement)
        graph = self.graphs[measurement.shape]
        if graph is None:
            graph = self.graphs[measurement.shape] = CudaGraph(self._reconstruct, measurement)
        return graph(measurement)

    def _reconstruct(self, measurement: Tensor) -> Tensor:
        if self.prepared is None:
            self.prepared = self.exact.prepare(self.psf, (self.psf.shape[-2], self.psf.shape[-1]))
        return self.network.reconstruct(measurement, self.prepared).float()


def half_precision(device: torch.device) -> torch.dtype | None:
    """Half-precision type that the device multiplies faster than float32, if there is one."""
    if device.type == "cuda":
        return torch.float16
    return torch.bfloat16 if has_bfloat16(device) else None
