"""A network bound to one PSF and one machine: what depends on neither measurement nor frame is computed once."""

import copy
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from mwdn.errors import ParameterError
from mwdn.inference.cuda_graph import CudaGraph
from mwdn.inference.fusion import fuse
from mwdn.runtime.devices import has_bfloat16, without_tf32
from mwdn.solvers.alignment import Pose
from mwdn.types import Measurement, Psf, Scene

Precision = Literal["fast", "exact"]
"""How a network computes. Fourier transforms are float32 in both.

- ``fast``: convolutions in half precision where the hardware has it (bfloat16 on a CPU, float16 on a GPU), else as
  ``exact``. Trained networks differ from it by 50 dB PSNR or more, their brightest pixel taken as 1 (``universal`` on
  real captures: 72 to 80 dB); one that amplifies rounding, such as a hardly trained MWDN-CPSF, by as little as 40 dB.
- ``exact``: float32, the network's own result but for the order of additions.
"""


class Engine:
    """A network as a function of the measurement alone.

    BatchNorm is folded into the convolutions, these take pixels with their channels side by side, and the transfer
    functions of the network's Wiener filters (with the whole PSF branch of MWDN-CPSF) are kept. On a GPU the
    calculation of each shape of a batch is recorded when it is met again, and then replayed; not where the PSF is
    aligned to each measurement.

    Memory is bounded: of a large picture the U-Net's convolutions are taken a strip of rows at a time, see
    `mwdn.inference.tiling`; of a large batch `mwdn.Reconstructor` takes a few pictures at a time.

    Args:
        network: as trained; a copy is taken.
        psf: (1, C, H, W), of the camera.
        precision: see `Precision`.

    Raises:
        ParameterError: unknown precision.
    """

    def __init__(self, network: nn.Module, psf: Psf, *, precision: Precision = "fast") -> None:
        if precision not in get_args(Precision):
            raise ParameterError(f"`precision` must be fast or exact, not {precision!r}.")
        self.psf, self.precision = psf, precision
        # Copied before it is moved: the caller's network stays where it is, and the PSF branch exact.
        own = copy.deepcopy(network).to(psf.device).eval().requires_grad_(False)
        half = half_precision(psf.device) if precision == "fast" else None
        self.folded = fuse(copy.deepcopy(own), half)
        # What binds the PSF, if anything does.
        self.network = fuse(own, None) if half is not None and hasattr(own, "bind") else self.folded
        self.bound: dict[int, list[Tensor]] = {}
        self.recordings: dict[torch.Size, CudaGraph | None] = {}

    @torch.inference_mode()
    def __call__(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch, (B, C, H, W), on the device of the PSF."""
        if measurement.device.type != "cuda":
            return self._reconstruct(measurement)
        # Streams are those of the current device; what stays float32 would else have the 10 bits of TF32.
        with torch.cuda.device(measurement.device), without_tf32():
            return self._recorded(measurement)

    def _recorded(self, measurement: Tensor) -> Tensor:
        if self.aligns:  # its equations wait for the GPU: nothing that could be recorded
            return self._reconstruct(measurement)
        if measurement.shape not in self.recordings:
            if len(self.recordings) >= 4:  # each holds the memory of a whole reconstruction
                self.recordings.clear()
            self.recordings[measurement.shape] = None
            return self._reconstruct(measurement)
        recording = self.recordings[measurement.shape]
        if recording is None:
            recording = self.recordings[measurement.shape] = CudaGraph(self._reconstruct, measurement)
        return recording(measurement)

    @property
    def aligns(self) -> bool:
        """Whether the network finds the pose of the PSF anew for each measurement."""
        return bool(getattr(self.network, "align", False))

    def at(self, pose: Pose) -> "Engine":
        """The same with the PSF in a pose that is known, where the network aligns; else this engine itself."""
        if not self.aligns:
            return self
        fixed = copy.copy(self)
        fixed.psf, fixed.bound, fixed.recordings = pose.move(self.psf), {}, {}
        fixed.network, fixed.folded = copy.copy(self.network), copy.copy(self.folded)  # of the same weights
        fixed.network.align = fixed.folded.align = False  # type: ignore[assignment]
        return fixed

    def _reconstruct(self, measurement: Tensor) -> Tensor:
        if not hasattr(self.folded, "bind"):
            return self.folded(measurement, self.psf).float()
        colours = measurement.shape[1]
        if colours not in self.bound:
            self.bound[colours] = self.network.bind(self.psf, measurement)  # type: ignore[operator]
        return self.folded.reconstruct(measurement, self.bound[colours]).float()  # type: ignore[operator]


def half_precision(device: torch.device) -> torch.dtype | None:
    """What the device multiplies faster than float32, if anything."""
    if device.type == "cuda":
        return torch.float16
    return torch.bfloat16 if has_bfloat16(device) else None
