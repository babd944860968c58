"""A reconstruction of one camera as a file that other programs run: ONNX, or torch's own ``.pt2``.

Network, PSF and picture size are fixed in it. A file counts once it has been run on a simulated capture and given what
the `Reconstructor` gives; otherwise nothing is written.
"""

import copy
import json
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram
from torch.utils._pytree import tree_flatten, tree_unflatten

from mwdn.calibration import Calibration
from mwdn.errors import ExportError, ParameterError
from mwdn.export.onnx_program import to_onnx
from mwdn.inference.fusion import fuse
from mwdn.inference.reconstructor import Method, Reconstructor, find_method
from mwdn.io.files import atomic
from mwdn.io.pictures import dark_scene
from mwdn.networks.network import Network, as_network
from mwdn.optics import Camera, Sensor
from mwdn.types import Measurement, Psf, Scene
from mwdn.version import __version__

Precision = Literal["float32", "float16", "int8"]
"""How the convolutions of a file compute; Fourier transforms are float32 in all.

- ``float32``: as the network does.
- ``float16``: weights of half the size; faster where the hardware has such units, which few CPUs have.
- ``int8``: weights of a quarter, ONNX alone: the range of each layer is found with simulated captures.
"""

LEAST: dict[str, float] = {"float32": 80.0, "float16": 50.0, "int8": 30.0}
"""PSNR in dB, its peak the brightest pixel of the exact result, below which a file does not count."""


ABOUT = "mwdn.json"
"""Name under which a ``.pt2`` file holds what is said about it; an ONNX file holds it as its metadata."""


@dataclass(frozen=True)
class Exported:
    """A file that has been run and compared.

    Args:
        path: of the file.
        agreement: its PSNR against the exact reconstruction, in dB; that of the worst of the captures.
        about: what is stored in the file: method, version, PSF, size, units.
    """

    path: Path
    agreement: float
    about: dict[str, str]


class Bound(nn.Module):
    """A method as a function of the measurement alone, in operations that other programs know.

    Args:
        method: a network or a solver.
        psf: (1, 1 or C, H, W).
        channels: of the measurement.
        dtype: of the convolutions, see `mwdn.inference.fusion.fuse`; ``None`` for float32.
    """

    def __init__(self, method: Method, psf: Psf, channels: int, *, dtype: torch.dtype | None = None) -> None:
        super().__init__()
        self.method: Method = method
        self.psf: Tensor
        self.register_buffer("psf", psf)
        if not isinstance(method, nn.Module):
            return
        network = as_network(copy.deepcopy(method)).cpu().eval().requires_grad_(False)
        tensors, self.layout = tree_flatten(network.prepare(psf, (psf.shape[-2], psf.shape[-1])))
        self.names = [f"prepared_{index}" for index in range(len(tensors))]
        for name, tensor in zip(self.names, tensors, strict=True):
            self.register_buffer(name, tensor)
        self.method = fuse(network, dtype, pack=False)

    def forward(self, measurement: Measurement) -> Scene:
        """Scene (B, C, H, W), float32, from a measurement of the PSF's size."""
        if not isinstance(self.method, Network):
            return self.method(measurement, self.psf).float()
        prepared = tree_unflatten([getattr(self, name) for name in self.names], self.layout)
        return self.method.reconstruct(measurement, prepared).float()


def export(
    method: Method | str | Path,
    calibration: Calibration,
    out: Path,
    *,
    precision: Precision = "float32",
    channels: int | None = None,
    regularisation: float | None = None,
    least: float | None = None,
) -> Exported:
    """Write a method bound to a camera to a file, run the file, and keep it if it gives what the method gives.

    The input ``measurement`` is what `Calibration.correct` gives, (B, channels, H, W) of any B; the output ``scene``
    is what `Reconstructor` gives. A network that aligns the PSF to each capture takes it as it is.

    Args:
        method: as for `Reconstructor`.
        calibration: of the camera.
        out: ends in ``.onnx`` or ``.pt2``. A file that exists is replaced once the new one has proved itself.
        precision: see `Precision`.
        channels: of the captures; those of the PSF unless given.
        regularisation: of a solver given by its name, in place of its default.
        least: agreement in dB that the file must reach, in place of `LEAST`.

    Raises:
        ExportError: the method has no form in this format, the file agrees too little, onnx or onnxruntime is not
            installed, or the disk refuses.
        ParameterError: another suffix or precision.
        UnknownNameError: no such method.
        CheckpointError: the checkpoint cannot be used.
        ShapeError: the network takes another number of channels.
    """
    _check(out, precision, channels)
    name = str(method) if isinstance(method, str | Path) else type(method).__name__
    options = {} if regularisation is None else {"regularisation": regularisation}
    found = find_method(method, **options) if isinstance(method, str | Path) else method
    channels = channels or calibration.psf.shape[1]
    about = _about(name, calibration, channels, precision)
    if isinstance(found, Network) and found.align:
        about["alignment"] = "off: the PSF is taken as it is"
    measurement = simulated(calibration, ("astronaut",), channels)
    expected = Reconstructor(found, calibration, align=False, device="cpu", precision="exact")(measurement)
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        bound = Bound(found, calibration.psf, channels, dtype=torch.float16 if precision == "float16" else None)
        file = Path(folder) / out.name
        _save(file, _program(bound.eval(), measurement), about)
        if precision == "int8":
            from mwdn.export.quantise import quantise

            with _explained(file):
                quantise(file, simulated(calibration, ("cat", "coffee"), channels))
        reached, bar = agreement(run_file(file, measurement), expected), LEAST[precision] if least is None else least
        if not reached >= bar:
            raise ExportError(
                f"`{out}` must agree with `{name}` to {bar:.1f} dB, but does to {reached:.1f} dB; it is not written. "
                f"{'Report this' if precision == 'float32' else 'Use `--precision float32`'}, or lower `--least`."
            )
        _publish(file, out)
    return Exported(out, reached, about)


def run_file(file: Path, measurement: Measurement) -> Scene:
    """Reconstruct a batch with an exported file, on the CPU.

    Raises:
        ExportError: onnxruntime is not installed, or the file cannot be read or run.
    """
    if file.suffix == ".pt2":
        with _explained(file), torch.no_grad():
            return torch.export.load(file).module()(measurement)
    _need("onnxruntime")
    import onnxruntime

    with _explained(file):
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        return torch.from_numpy(session.run(["scene"], {"measurement": measurement.numpy()})[0])


def read_about(file: Path) -> dict[str, str]:
    """What an exported file says about itself: method, version, PSF, size, units."""
    if file.suffix == ".pt2":
        extra = {ABOUT: ""}
        torch.export.load(file, extra_files=extra)
        return json.loads(extra[ABOUT])
    import onnx

    return {entry.key: entry.value for entry in onnx.load(str(file)).metadata_props}


def agreement(found: Scene, expected: Scene) -> float:
    """PSNR in dB of the worst of a batch, its peak the brightest pixel of the batch as expected."""
    error = (found - expected).square().mean((1, 2, 3)).amax()
    return float(10 * torch.log10(expected.abs().max().square() / error))


def simulated(calibration: Calibration, names: tuple[str, ...], channels: int) -> Measurement:
    """Captures of the package's pictures in the dark: each bright, and dim and mirrored, (2 len(names), C, H, W).

    Args:
        calibration: of the camera that is simulated.
        names: of files in the folder ``pictures``.
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
    if precision not in get_args(Precision):
        raise ParameterError(f"`precision` must be float32, float16 or int8, not {precision!r}.")
    if out.suffix not in (".onnx", ".pt2"):
        raise ParameterError(f"`{out}` must end in .onnx or .pt2, not '{out.suffix}'.")
    if out.suffix == ".pt2" and precision == "int8":
        raise ParameterError("`precision` int8 exists in ONNX alone: `--out camera.onnx`.")
    if out.is_dir():
        raise ParameterError(f"`{out}` must be a file, but is a folder.")
    if out.suffix == ".onnx":
        _need("onnx", "onnxruntime")


def _need(*packages: str) -> None:
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise ExportError(f"ONNX needs the package {' and '.join(missing)}: `pip install 'mwdn[export]'`.")


@contextmanager
def _explained(file: Path) -> Iterator[None]:
    """Raise an `ExportError` for what onnxruntime and torch raise, which is of many kinds."""
    try:
        yield
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        again = "Export it again: as .onnx, as .pt2, or with another `--precision`."
        raise ExportError(f"`{file.name}` cannot be run: {reason.rstrip('.')}. {again}") from error


def _about(name: str, calibration: Calibration, channels: int, precision: str) -> dict[str, str]:
    """All that another program must know to use the file."""
    height, width = calibration.size
    about = {
        "method": name,
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
    if calibration.frames.bit_depth is not None:
        about["bit_depth"] = str(calibration.frames.bit_depth)
    if calibration.frames.crop is not None:
        about["crop"] = f"{calibration.frames.crop[0]} x {calibration.frames.crop[1]}"
    if calibration.frames.upside_down:
        about["rows"] = "raw frames have their first row at the bottom"
    if calibration.frames.bgr:
        about["colours"] = "raw frames have their channels in the order blue, green, red"
    if calibration.frames.mosaic:
        about["mosaic"] = calibration.frames.mosaic
    if calibration.frames.grey:
        about["grey"] = "the colours of raw frames must be averaged"
    if calibration.dark is not None:
        about["dark"] = "a frame taken without light must be subtracted from raw frames"
    return about


def _program(bound: Bound, measurement: Measurement) -> ExportedProgram:
    """The method as a list of operations, for batches of any size."""
    try:
        return torch.export.export(bound, (measurement,), dynamic_shapes=({0: Dim("batch", min=1)},))
    except (RuntimeError, ValueError, TypeError) as error:  # torch raises many kinds
        reason = str(error).strip().splitlines()[0]
        raise ExportError(f"`{type(bound.method).__name__}` cannot be exported: {reason}") from error


def _save(file: Path, program: ExportedProgram, about: dict[str, str]) -> None:
    if file.suffix == ".pt2":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's own, of weights with their channels side by side
            torch.export.save(program, file, extra_files={ABOUT: json.dumps(about)})
        return
    import onnx

    model = to_onnx(program)
    onnx.helper.set_model_props(model, about)
    model.producer_name, model.producer_version = "mwdn", about["version"]
    if model.ByteSize() >= onnx.checker.MAXIMUM_PROTOBUF:
        size = model.ByteSize() / 2**30
        raise ExportError(f"The file would have {size:.1f} GB; ONNX files hold 2. Export to .pt2, or `--bin 2`.")
    onnx.checker.check_model(model)
    onnx.save(model, str(file))


def _publish(file: Path, out: Path) -> None:
    try:
        with atomic(out) as temporary:
            shutil.copyfile(file, temporary)
    except OSError as error:
        raise ExportError(f"`{out}` cannot be written: {error.strerror or error}. Choose another folder.") from error
