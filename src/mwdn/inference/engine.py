"""Fast inference with one network, PSF and device: PSF preparation, fused layers, half precision, CUDA graphs."""

import copy
from typing import Any, Generic, Literal, cast, get_args

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.inference.cuda_graph import CudaGraph
from mwdn.inference.fusion import fuse
from mwdn.networks.network import Network, Prepared
from mwdn.optics.psf import checked_psf
from mwdn.runtime.devices import has_bfloat16, without_tf32
from mwdn.types import Measurement, Psf, Scene, size_of

Precision = Literal["fast", "exact"]
"""Precision of a network's convolutions. Fourier transforms are float32 in both.

- ``fast``: half precision where the hardware has it (bfloat16 on a CPU, float16 on a GPU), else as ``exact``. The PSNR
  against ``exact``, for a brightest pixel of 1, is 50 dB or more for trained networks (``universal`` on real captures:
  72 to 80 dB), and can be as low as 40 dB for one that amplifies rounding, such as a hardly trained MWDN-CPSF.
- ``exact``: float32; the network's result up to the order of additions.
"""


class Engine(Generic[Prepared]):
    """A network optimised for inference with one PSF; it is called with a measurement only.

    BatchNorm is fused into the convolutions, which use channels-last features. The PSF is prepared once, in float32.
    On a GPU the computation for each batch shape is recorded as a CUDA graph at its second call and replayed later.

    Memory is bounded: U-Nets process large pictures in strips (`mwdn.inference.tiling`), and `mwdn.Reconstructor`
    divides large batches.

    Args:
        network: the trained network, which is copied.
        psf: (1 or B, C, H, W); each channel is scaled to unit sum, unless the network has ``stored_psf``.
        precision: see `Precision`.

    Raises:
        ParameterError: unknown precision.
    """

    def __init__(self, network: Network[Prepared], psf: Psf, *, precision: Precision = "fast") -> None:
        if precision not in get_args(Precision):
            raise ParameterError(f"`precision` must be fast or exact, not {precision!r}.")
        self.precision, psf = precision, checked_psf(psf, scale=not network.stored_psf)
        exact = copy.deepcopy(network).to(psf.device).float().eval().requires_grad_(False)
        half = half_precision(psf.device) if precision == "fast" else None
        self.network = cast(Network[Prepared], fuse(exact if half is None else copy.deepcopy(exact), half))
        # Prepares the PSF, because spectra and regularisation need float32.
        self.exact = self.network if half is None else cast(Network[Prepared], fuse(exact, None))
        self._set_psf(psf)

    def _set_psf(self, psf: Psf) -> None:
        self.psf = psf
        self.prepared: Prepared | None = None
        self.graphs: dict[torch.Size, CudaGraph | None] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Without the CUDA graphs, which belong to this process, and the prepared PSF, which can be large."""
        return {**vars(self), "graphs": {}, "prepared": None}

    def with_psf(self, psf: Psf) -> "Engine[Prepared]":
        """An engine with another PSF that shares the network and its weights."""
        other = copy.copy(self)
        other._set_psf(psf)
        return other

    @torch.inference_mode()
    def __call__(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch, (B, C, H, W), on the device of the PSF."""
        measurement = measurement.float()
        if measurement.device.type != "cuda":
            return self._reconstruct(measurement)
        # CUDA streams belong to the current device. Without TF32, float32 operations keep 23 bits.
        with torch.cuda.device(measurement.device), without_tf32():
            return self._replay(measurement)

    def _replay(self, measurement: Tensor) -> Tensor:
        if measurement.shape not in self.graphs:
            if len(self.graphs) >= 4:  # each graph keeps the memory of a whole reconstruction
                self.graphs.clear()
            self.graphs[measurement.shape] = None
            return self._reconstruct(measurement)
        graph = self.graphs.get(measurement.shape)  # another thread may have cleared them
        if graph is None:
            graph = self.graphs[measurement.shape] = CudaGraph(self._reconstruct, measurement)
        return graph(measurement)

    def _reconstruct(self, measurement: Tensor) -> Tensor:
        if self.prepared is None:
            self.prepared = self.exact.prepare(self.psf, size_of(self.psf))
        return self.network.reconstruct(measurement, self.prepared).float()


def half_precision(device: torch.device) -> torch.dtype | None:
    """Half-precision type that is faster than float32 on the device, or ``None``."""
    if device.type == "cuda":
        return torch.float16
    return torch.bfloat16 if has_bfloat16(device) else None
