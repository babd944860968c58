"""A network bound to one PSF and one machine: what depends on neither measurement nor frame is computed once."""

import copy
from collections.abc import Callable
from typing import Any, Literal, TypeGuard, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.errors import ParameterError
from mwdn.learning.precision import has_bfloat16, without_tf32
from mwdn.networks.blocks import Decoder, Encoder
from mwdn.solvers.alignment import Pose
from mwdn.tiles import StripDecoder, StripEncoder
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
    `mwdn.tiles`; of a large batch `mwdn.Reconstructor` takes a few pictures at a time.

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
        self.folded = fold(copy.deepcopy(own), half)
        # What binds the PSF, if anything does.
        self.network = fold(own, None) if half is not None and hasattr(own, "bind") else self.folded
        self.bound: dict[int, list[Tensor]] = {}
        self.recordings: dict[torch.Size, _Recording | None] = {}

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
            recording = self.recordings[measurement.shape] = _Recording(self._reconstruct, measurement)
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


FEW = 16
"""A convolution from or to fewer channels sees the picture itself and stays float32: it costs little. In eight bits a
bright measurement would lose the faint contrast that the Wiener filters amplify (up to 20 dB PSNR), and the
reconstruction its finest steps of brightness (1 to 5 dB)."""


class Convolution(nn.Module):
    """A convolution, what is left of the BatchNorm after it, and its ReLU, in one pass.

    Args:
        convolution: of stride 1, not grouped.
        norm: the BatchNorm after it, if there is one.
        relu: whether a ReLU comes last.
        dtype: to compute in; ``None`` for float32, in which `FEW` channels are always.
    """

    def __init__(
        self, convolution: nn.Conv2d, norm: nn.BatchNorm2d | None, *, relu: bool, dtype: torch.dtype | None
    ) -> None:
        super().__init__()
        weight = convolution.weight.detach().double()
        bias = torch.zeros_like(weight[:, 0, 0, 0]) if convolution.bias is None else convolution.bias.detach().double()
        if norm is not None:
            # y = (conv - mean) scale + shift is a convolution with other numbers.
            mean, variance = norm.state_dict()["running_mean"].double(), norm.state_dict()["running_var"].double()
            scale = norm.weight.double() / (variance + norm.eps).sqrt()
            weight, bias = weight * scale[:, None, None, None], (bias - mean) * scale + norm.bias
        few = min(convolution.in_channels, convolution.out_channels) < FEW
        self.dtype = torch.float32 if dtype is None or few else dtype
        self.relu, self.padding = relu, [int(p) for p in convolution.padding]
        self.weight = weight.to(self.dtype).contiguous(memory_format=torch.channels_last)
        self.bias = bias.to(self.dtype)
        self.packed = _packed(self.weight, self.padding)

    def forward(self, features: Tensor) -> Tensor:
        """Features, channels-last, in the precision of the weights."""
        features = features.to(self.dtype).contiguous(memory_format=torch.channels_last)
        if self.packed is None:
            result = F.conv2d(features, self.weight, self.bias, padding=self.padding)
            return result.relu_() if self.relu else result
        last = "relu" if self.relu else "none"
        fused = torch.ops.mkldnn._convolution_pointwise
        return fused(features, self.packed, self.bias, self.padding, [1, 1], [1, 1], 1, last, [], "")


class Float32(nn.Module):
    """A layer that is left as it is, after others that compute in half precision."""

    def __init__(self, layer: nn.Module) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, features: Tensor, **options: Any) -> Tensor:  # noqa: ANN401
        """Features, in float32."""
        return self.layer(features.float(), **options)


def _packed(weight: Tensor, padding: list[int]) -> Tensor | None:
    """Weights in the order that oneDNN reads, where torch has it and can fuse the ReLU; else ``None``.

    Both are what torch's own compiler uses, but no public interface: any other form of them is left alone.
    """
    if weight.device.type != "cpu" or not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return None
    try:
        packed = torch._C._nn.mkldnn_reorder_conv2d_weight(weight.to_mkldnn(), padding, [1, 1], [1, 1], 1)
        probe = weight.new_ones((1, weight.shape[1], 4, 4)).contiguous(memory_format=torch.channels_last)
        bias = torch.zeros_like(weight[:, 0, 0, 0])
        fused = torch.ops.mkldnn._convolution_pointwise
        found = fused(probe, packed, bias, padding, [1, 1], [1, 1], 1, "relu", [], "").float()
    except (AttributeError, RuntimeError, TypeError):
        return None
    expected = F.conv2d(probe.float(), weight.float(), padding=padding).relu()
    return packed if torch.allclose(found, expected, rtol=0.05, atol=0.05 * expected.max().item()) else None


def fold(module: nn.Module, dtype: torch.dtype | None) -> nn.Module:
    """Replace each convolution, with the BatchNorm and the ReLU right after it, by one `Convolution`; in place.

    The U-Nets that are then nothing else work in strips.
    """
    if isinstance(module, nn.Sequential):
        return nn.Sequential(*_folded(list(module), dtype))
    for name, child in module.named_children():
        setattr(module, name, fold(child, dtype))
    if isinstance(module, Encoder | Decoder) and all(
        isinstance(layer, Convolution) for scale in module.scales for layer in scale.children()
    ):
        return StripEncoder(module) if isinstance(module, Encoder) else StripDecoder(module)
    if _plain(module):
        return Convolution(module, None, relu=False, dtype=dtype)
    return Float32(module) if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear) else module


def _folded(layers: list[nn.Module], dtype: torch.dtype | None) -> list[nn.Module]:
    result: list[nn.Module] = []
    while layers:
        layer = layers.pop(0)
        if not _plain(layer):
            result.append(fold(layer, dtype))
            continue
        norm = layers[0] if layers and isinstance(layers[0], nn.BatchNorm2d) else None
        layers = layers[norm is not None :]
        relu = bool(layers) and isinstance(layers[0], nn.ReLU)
        layers = layers[relu:]
        result.append(Convolution(layer, norm, relu=relu, dtype=dtype))
    return result


def _plain(layer: nn.Module) -> TypeGuard[nn.Conv2d]:
    """Whether it is a convolution of the kind that `Convolution` knows."""
    return (
        isinstance(layer, nn.Conv2d)
        and (layer.stride, layer.dilation, layer.groups) == ((1, 1), (1, 1), 1)
        and layer.padding_mode == "zeros"
        and not isinstance(layer.padding, str)
    )


class _Recording:
    """A calculation on a GPU, recorded for one shape and replayed: its hundreds of kernels start as one."""

    def __init__(self, calculate: Callable[[Tensor], Tensor], measurement: Tensor) -> None:
        self.calculate = calculate
        self.graph: torch.cuda.CUDAGraph | None = None
        self.measurement = measurement.clone()
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # libraries choose their algorithms and plan their transforms
                calculate(self.measurement)
        current = torch.cuda.current_stream()
        current.wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        try:
            # torch's own stream for this is of whichever GPU recorded first. Other threads may read or judge meanwhile.
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self.result = calculate(self.measurement)
        except RuntimeError:  # something that cannot be recorded: calculate each time
            torch.cuda.set_stream(current)  # a recording that fails leaves its own
            return
        self.graph = graph

    def __call__(self, measurement: Tensor) -> Tensor:
        if self.graph is None:
            return self.calculate(measurement)
        self.measurement.copy_(measurement)
        self.graph.replay()
        return self.result.clone()
