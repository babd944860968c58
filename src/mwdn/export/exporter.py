"""Export a method for one camera as a file that other programs run: ONNX, or torch's own ``.pt2``.

Network, PSF and picture size are fixed in the file. It is run on simulated captures and written only if its results
agree with those of `Reconstructor`.
"""

import copy
import tempfile
import warnings
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.export import Dim
from torch.utils._pytree import tree_flatten, tree_unflatten

from mwdn.arguments import checked
from mwdn.calibration import Calibration
from mwdn.errors import ExportError, ParameterError
from mwdn.export.loops import as_loops
from mwdn.export.model_file import as_export_error, publish, require_onnx, run_file, trace, write_file
from mwdn.inference.fusion import fuse
from mwdn.inference.methods import Method, as_method, method_name, psf_for, psf_warning
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import refuse_overwrite
from mwdn.io.pictures import dark_scene
from mwdn.networks.network import Network, as_network
from mwdn.optics import Camera, Sensor
from mwdn.types import Measurement, Psf, Scene, size_of
from mwdn.version import __version__

Precision = Literal["float32", "float16", "int8"]
"""Precision of a file's convolutions; Fourier transforms are always float32.

- ``float32``: as in the network.
- ``float16``: weights of half the size; faster on hardware with float16 units, which few CPUs have.
- ``int8``: weights of a quarter of the size, ONNX only; simulated captures give the range of each layer.
"""

MIN_AGREEMENT: dict[str, float] = {"float32": 80.0, "float16": 50.0, "int8": 30.0}
"""Minimum PSNR in dB of a file's result against the exact one, whose brightest pixel is the peak."""


@dataclass(frozen=True)
class Exported:
    """A file that has been written, run and compared.

    Args:
        path: of the file.
        agreement: PSNR in dB against the exact reconstruction, of the worst capture.
        about: description stored in the file: method, version, PSF, size, units.
    """

    path: Path
    agreement: float
    about: dict[str, str]


class FixedPsf(nn.Module):
    """A method with a fixed PSF: a function of the measurement alone, which torch can export.

    Args:
        method: a network or a solver.
        psf: (1, 1 or C, H, W).
        dtype: of the convolutions, see `mwdn.inference.fusion.fuse`; ``None`` for float32.
    """

    def __init__(self, method: Method, psf: Psf, *, dtype: torch.dtype | None = None) -> None:
        super().__init__()
        self.method: Method = method
        self.psf: Tensor
        self.register_buffer("psf", psf)
        if not isinstance(method, nn.Module):
            return
        network = as_network(copy.deepcopy(method)).cpu().float().eval().requires_grad_(False)
        tensors, self.layout = tree_flatten(network.prepare(psf, size_of(psf)))
        self.names = [f"prepared_{index}" for index in range(len(tensors))]
        for name, tensor in zip(self.names, tensors, strict=True):
            self.register_buffer(name, tensor)
        self.method = fuse(network, dtype, pack=False)  # packed weights fit this machine only

    def forward(self, measurement: Measurement) -> Scene:
        """Scene (B, C, H, W), float32, from a measurement of the PSF's size."""
        if not isinstance(self.method, Network):
            return self.method(measurement, self.psf).float()
        prepared = tree_unflatten([getattr(self, name) for name in self.names], self.layout)
        return self.method.as_recorded(self.method.reconstruct(measurement, prepared).float())


@checked
def export(
    method: Method | str | Path,
    calibration: Calibration,
    out: str | Path,
    *,
    precision: Precision = "float32",
    channels: int | None = None,
    least: float | None = None,
    **options: Any,  # noqa: ANN401
) -> Exported:
    """Write a method for one camera to a file, run the file, and keep it if its results agree.

    The input ``measurement`` is the result of `Calibration.correct`, (B, channels, H, W) for any B; the output
    ``scene`` is that of `Reconstructor` without alignment of the PSF.

    Args:
        method: as for `Reconstructor`.
        calibration: of the camera.
        out: ends in ``.onnx`` or ``.pt2``; an existing file is replaced only on success.
        precision: see `Precision`.
        channels: of the captures; those of the PSF unless given.
        least: minimum agreement in dB, in place of `MIN_AGREEMENT`.
        **options: of a solver given by its name, for example ``regularisation=1e-4``.

    Raises:
        ExportError: the method cannot be written in this format, the file's results agree too little, or the file
            cannot be written.
        MissingPackageError: onnx or onnxruntime is not installed.
        ParameterError: another suffix, an argument of another type, ``out`` is a symbolic link, or options of a
            method that is not given by its name.
        UnknownNameError: no such method, option or precision.
        CheckpointError: the checkpoint cannot be used.
        ShapeError: the network takes another number of channels.
    """
    out = Path(out)
    _check(out, precision, channels)
    refuse_overwrite(out)
    given, name = method, method_name(method)
    method = as_method(method, **options)
    if precision != "float32" and not isinstance(method, nn.Module):
        raise ParameterError(f"`precision` ({precision}) is for networks: a solver has no convolutions. Leave it out.")
    if channels == 1 < calibration.psf.shape[1]:
        raise ParameterError("`channels` (1) must be 3, because the PSF has colours. For a grey camera: `grey`.")
    channels = channels or calibration.psf.shape[1]
    about = _about(name, calibration, channels, precision)
    if isinstance(method, Network) and method.align:
        about["alignment"] = "off: the PSF is taken as it is"
    measurement = simulate_captures(calibration, ("astronaut",), channels)
    exact = exact_reconstructor(given, method, calibration)
    expected = exact.as_recorded(exact.on_device(measurement))
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / out.name
        module = FixedPsf(method, psf_for(method, calibration), dtype=torch.float16 if precision == "float16" else None)
        with as_loops() if file.suffix == ".onnx" else nullcontext():  # a .pt2 file has its iterations unrolled
            any_batch = ({0: Dim("batch", min=1)},)
            program = trace(module, (measurement,), f"`{type(module.method).__name__}`", dynamic_shapes=any_batch)
        write_file(file, program, about)
        if precision == "int8":
            from mwdn.export.quantise import quantise

            with as_export_error(file):
                quantise(file, simulate_captures(calibration, ("cat", "coffee"), channels))
        reached = agreement(run_file(file, measurement), expected)
        check_agreement(reached, f"`{out}`", name, least=least, precision=precision)
        publish(file, out)
    return Exported(out, reached, about)


def exact_reconstructor(given: Method | str | Path, method: Method, calibration: Calibration) -> Reconstructor:
    """What a file of the method is compared with; warns if the network, as given, is for another PSF."""
    exact = Reconstructor(method, calibration, align=False, room_light=False, device="cpu", precision="exact")
    warning = (psf_warning(given, calibration) if isinstance(given, str | Path) else None) or exact.warning
    if warning:
        warnings.warn(warning, stacklevel=4)
    return exact


def agreement(result: Scene, expected: Scene) -> float:
    """PSNR in dB of the worst picture of a batch; the peak is the brightest expected pixel of the batch."""
    error = (result - expected).square().mean((1, 2, 3)).amax()
    return float(10 * torch.log10(expected.abs().max().square() / error))


def required_agreement(least: float | None, precision: Precision = "float32") -> float:
    """Minimum agreement in dB: ``least`` if it is given, otherwise that of the precision."""
    return MIN_AGREEMENT[precision] if least is None else least


def check_agreement(
    reached: float, output: str, method: str, *, least: float | None = None, precision: Precision = "float32"
) -> None:
    """Raise an `ExportError`, which names output and method, unless the agreement is the `required_agreement`."""
    required = required_agreement(least, precision)
    if not reached >= required:  # also refuses NaN
        raise ExportError(
            f"{output} must agree with `{method}` to {required:.1f} dB, but does to {reached:.1f} dB; it is not "
            f"written. {'Report this' if precision == 'float32' else 'Use `--precision float32`'}, or lower `--least`."
        )


def simulate_captures(calibration: Calibration, names: tuple[str, ...], channels: int) -> Measurement:
    """Captures of bundled pictures on black: each bright, and mirrored and dim, (2 len(names), C, H, W).

    Args:
        calibration: of the simulated camera.
        names: of `mwdn.io.pictures.PICTURES`.
        channels: 1 or 3.
    """
    side = max(1, min(calibration.size) // 2)
    scenes = torch.cat([dark_scene(name, calibration.size, side) for name in names])
    scenes = scenes if channels == 3 else scenes.mean(1, keepdim=True)
    light = Camera(calibration.psf).forward(torch.cat([scenes, scenes.flip(-1)]))
    exposure = torch.tensor([0.9, 0.3]).repeat_interleave(len(names))[:, None, None, None]
    light = light * exposure / light.amax((1, 2, 3), keepdim=True)
    return Sensor().expose(light, generator=torch.Generator().manual_seed(0))


def _check(out: Path, precision: str, channels: int | None) -> None:
    if channels not in (None, 1, 3):
        raise ParameterError(f"`channels` ({channels}) must be 1 or 3: grey or RGB.")
    if out.suffix not in (".onnx", ".pt2"):
        raise ParameterError(f"`{out}` must end in .onnx or .pt2, not '{out.suffix}'.")
    if out.suffix == ".pt2" and precision == "int8":
        raise ParameterError("`precision` int8 exists in ONNX only: `--out camera.onnx`.")
    if out.is_dir():
        raise ParameterError(f"`{out}` must be a file, but is a folder.")
    if out.suffix == ".onnx":
        require_onnx()


def _about(name: str, calibration: Calibration, channels: int, precision: str) -> dict[str, str]:
    """Description of a file: what another program needs to know to use it."""
    height, width = calibration.size
    about = {
        "method": Path(name).name if Path(name).is_absolute() else name,  # folders may name people and projects
        "version": __version__,
        "precision": precision,
        "psf_hash": calibration.psf_hash,
        "size": f"{height} x {width}",
        "channels": "RGB" if channels == 3 else str(channels),
        "axes": "batch, channel, height, width; row 0 at the top",
        "measurement": "float32, linear light, dark level subtracted, 1 is saturation",
        "scene": "float32, linear light, not clipped to [0, 1]",
        "binning": str(calibration.frames.bin),
    }
    frames, corrections, refinement = calibration.frames, calibration.corrections, calibration.refinement
    crop = (str(length // frames.cell) for length in frames.crop or ())  # in pixels of the colours, after demosaicing
    more = {
        "white_balance": (calibration.white_balance, f"not applied to the scene: {calibration.white_balance}"),
        "bit_depth": (frames.bit_depth, str(frames.bit_depth)),
        "crop": (frames.crop, " x ".join(crop)),
        "rows": (frames.upside_down, "raw frames have their first row at the bottom"),
        "colours": (frames.bgr, "raw frames have their channels in the order blue, green, red"),
        "mosaic": (frames.mosaic, str(frames.mosaic)),
        "grey": (frames.grey, "the colours of raw frames must be averaged"),
        "gamma": (frames.gamma, str(frames.gamma)),
        "ambient": (
            calibration.ambient is not None,
            "a frame taken with the room's light alone must be subtracted from raw frames",
        ),
        "dark": (
            calibration.dark is not None and calibration.ambient is None,
            "a frame taken without light must be subtracted from raw frames",
        ),
        "flat": (corrections.flat is not None, "raw frames must be divided by the camera's flat field"),
        "hot_pixels": (
            corrections.count,
            f"{corrections.count} pixels of raw frames must be replaced by neighbours",
        ),
        "stray_light": (refinement.stray_light, "the camera's stray light must be subtracted from measurements"),
        "sensor_field": (refinement.sensor_field, "measurements must be divided by the camera's sensor field"),
    }
    return about | {key: text for key, (applies, text) in more.items() if applies}
