"""Reconstruction of one camera's measurements and raw frames by any method."""

import copy
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, overload

import torch
from torch import Tensor, nn

from mwdn import solvers
from mwdn.calibration import Calibration
from mwdn.errors import CheckpointError, ParameterError, ShapeError, UnknownNameError
from mwdn.fourier.convolution import check_fit
from mwdn.inference.engine import Engine, Precision
from mwdn.io.formats import as_frame
from mwdn.networks import DENOISERS, NETWORKS
from mwdn.networks.blocks import check_channels
from mwdn.networks.network import Network, as_network
from mwdn.runtime.devices import select_device
from mwdn.runtime.transfers import to_device, to_host
from mwdn.types import ArrayPicture, FloatFrame, Frame, Measurement, Psf, Scene
from mwdn.weights.bundled import BUNDLED, find_weights
from mwdn.weights.checkpoint import SUFFIXES, load_checkpoint, read_metadata

PIXELS_PER_CHUNK = {"cpu": 2**17, "cuda": 2**24}
"""Default of `Reconstructor.pixels_per_chunk` on each type of device. A GPU needs many pixels for full load. On a CPU,
batches of 320 x 320 pictures are 15 % (MWDN) or 50 % (ADMM) slower than single pictures because of cache misses."""

Method = Callable[[Measurement, Psf], Scene]
"""A solver or a network, called as ``method(measurement, psf)``."""


def find_method(name: str | Path, **options: Any) -> Method:  # noqa: ANN401
    """Find a solver or a bundled network by its name, or a network by the path of its checkpoint.

    Args:
        name: the name or the path; ``hub:owner/name`` for a network on the Hugging Face hub.
        **options: of a solver, for example ``regularisation=1e-4``. A network's options are in its checkpoint.

    Raises:
        UnknownNameError: neither a solver nor a file, or the solver has no such option.
        CheckpointError: the file holds no usable weights.
        ParameterError: an option is out of range, a network is given options, or a network needs training first.
    """
    if str(name) in solvers.SOLVERS:
        return solvers.build(str(name), **options)
    if options:
        names = ", ".join(f"`{option}`" for option in options)
        raise ParameterError(
            f"{names} cannot be set for '{name}': only solvers ({', '.join(solvers.SOLVERS)}) have options. "
            "See `mwdn methods`."
        )
    path = find_weights(str(name)) or Path(name)
    if path.suffix in SUFFIXES or path.is_file():
        network = load_checkpoint(path)
        if isinstance(network, tuple(DENOISERS.values())):
            raise CheckpointError(
                f"`{name}` holds a denoiser, which cannot reconstruct on its own. Use it as `denoiser` in [schedule] "
                "of a recipe such as recipes/universal-plug.toml."
            )
        return network
    if str(name) in NETWORKS:
        raise ParameterError(
            f'`{name}` is a network without weights. Train it with `name = "{name}"` in [network] of the recipe: '
            f"`mwdn train RECIPE.toml --psf psf.png --photos photos/ --out runs/{name}`. The method is then "
            f"`runs/{name}/best.safetensors`. `universal` needs no training."
        )
    raise UnknownNameError("method", str(name), [*BUNDLED, *solvers.SOLVERS, "PATH/OF/CHECKPOINT.safetensors"])


def _psf_warning(method: str | Path, calibration: Calibration) -> str | None:
    """Warning if the network was trained for another PSF than the calibration's."""
    path = find_weights(str(method)) or Path(method)
    if path.suffix != ".safetensors":
        return None
    trained = read_metadata(path).get("psf_hash")
    if trained in (None, calibration.psf_hash):
        return None
    return (
        f"`{method}` was trained for PSF {trained}, but the calibration has PSF {calibration.psf_hash}. "
        "Expect blur, ghosts and invented detail, unless both are from the same camera: another crop, binning or "
        "background counts as another PSF. Use the PSF of the training, or train for this one: `mwdn train`."
    )


class Reconstructor:
    """Reconstruct the measurements of one camera.

    On a CPU, calling `mwdn.keep_memory` first reduces the time for large pictures to 0.4 to 0.7.

    Args:
        method: a solver, a network, the name of a solver or of a bundled network, or the path of a checkpoint.
        calibration: of the camera.
        align: whether to fit rotation, scale and haze of the PSF to each measurement first (`mwdn.align`), for a camera
            that has changed since its calibration. ``None`` does as the network was trained: ``universal`` aligns;
            ``universal-small`` and solvers do not.
        device: a GPU if there is one, unless given.
        precision: of a network, see `mwdn.inference.engine.Precision`; solvers are always exact.
        **options: of a solver given by its name, for example ``regularisation=1e-4``.

    Attributes:
        method: the solver or network. Later changes of a network have no effect: a copy reconstructs.
        warning: why the result may be wrong, or ``None``.
        pixels_per_chunk: pixels of a batch that are reconstructed together.

    Raises:
        UnknownNameError: no such method, or it has no such option.
        CheckpointError: the checkpoint cannot be used.
        ParameterError: ``calibration`` is no `Calibration`, no such device or precision, an option is out of range, or
            the network has no weights.
    """

    def __init__(
        self,
        method: Method | str | Path,
        calibration: Calibration,
        *,
        align: bool | None = None,
        device: str | torch.device | None = None,
        precision: Precision = "fast",
        **options: Any,  # noqa: ANN401
    ) -> None:
        if not isinstance(calibration, Calibration):
            raise ParameterError(
                f"`calibration` ({type(calibration).__name__}) must be a `Calibration`: "
                "`Calibration.from_file('psf.png')`."
            )
        self.device = select_device(device)
        self.pixels_per_chunk = PIXELS_PER_CHUNK.get(self.device.type, PIXELS_PER_CHUNK["cpu"])
        self.calibration = calibration
        self.warning = None
        if isinstance(method, str | Path):
            self.warning = _psf_warning(method, calibration)
            method = find_method(method, **options)
        elif options:
            raise ParameterError(f"Options ({', '.join(options)}) need a method given by its name, not an object.")
        self.method: Method = method
        self.align = method.align if align is None and isinstance(method, Network) else bool(align)
        self.psf = calibration.psf.to(self.device)
        self.engine = None
        if isinstance(method, nn.Module):
            self.engine = Engine(as_network(method), self.psf, precision=precision)

    def at(self, pose: solvers.Pose) -> "Reconstructor":
        """A `Reconstructor` with a fixed pose of the PSF, instead of one estimated for each measurement.

        Without alignment, returns this `Reconstructor` unchanged.

        Args:
            pose: result of `mwdn.align` for one capture, or with an entry for each sample of a batch.
        """
        if not self.align:
            return self
        fixed = copy.copy(self)
        fixed.align, fixed.psf = False, pose.move(self.psf)
        fixed.engine = self.engine and self.engine.with_psf(fixed.psf)
        return fixed

    def stream(self, frames: Iterable[Frame], *, refresh: int = 100) -> Iterator[tuple[Measurement, Scene]]:
        """Reconstruct the frames of a video, faster than one by one because successive frames are similar.

        With alignment, the pose of the first frame is reused. ADMM and FISTA start from the previous result
        (`mwdn.solvers.WarmStart`). Other methods treat frames independently.

        All frames are reconstructed. To skip to the newest frame of a live camera:
        ``stream(mwdn.runtime.streams.latest(camera))``.

        Args:
            frames: raw frames.
            refresh: align again after this number of frames; 0 for never.

        Yields:
            Measurement and scene, as `__call__` returns it.

        Raises:
            ParameterError: ``refresh`` is negative.
            MwdnError: a frame does not fit the camera. A frame with NaN gives a scene with NaN and affects no other.
        """
        if refresh < 0:
            raise ParameterError(f"`refresh` ({refresh}) must be a number of frames, or 0 for never.")
        return self._stream(frames, refresh)

    def _stream(self, frames: Iterable[Frame], refresh: int) -> Iterator[tuple[Measurement, Scene]]:
        aligning = copy.copy(self)
        if isinstance(self.method, solvers.Admm | solvers.Fista):
            aligning.method = solvers.WarmStart(self.method)
        reconstruct, due = aligning, self.align
        for number, frame in enumerate(frames):
            measurement = self.calibration.correct(frame)
            due |= self.align and refresh > 0 and number % refresh == 0
            if due and measurement.isfinite().all():  # else on the next frame
                reconstruct = aligning.at(solvers.align(to_device(measurement, self.device), self.psf))
                due = False
            yield measurement, reconstruct(measurement)

    def _reconstruct(self, measurement: Measurement) -> Scene:
        if self.align:
            return self.at(solvers.align(measurement, self.psf))._reconstruct(measurement)
        return self.engine(measurement) if self.engine else self.method(measurement, self.psf)

    def _pictures_per_chunk(self, measurement: Measurement) -> int:
        """Pictures of a batch that are reconstructed together."""
        if isinstance(self.method, solvers.WarmStart) or len(self.psf) > 1:
            return len(measurement)  # each picture has its own previous result or pose
        return max(1, self.pixels_per_chunk // (measurement.shape[-2] * measurement.shape[-1]))

    def _check(self, measurement: Measurement) -> None:
        if not measurement.is_floating_point():
            raise ParameterError(
                f"`measurement` ({measurement.dtype}) must be floats in linear light; raw frames go through "
                "`Calibration.correct`."
            )
        shape = tuple(measurement.shape)
        if len(shape) != 4 or 0 in shape:
            raise ShapeError(
                f"`measurement` {shape} must be a non-empty batch (B, C, H, W). For one picture: `measurement[None]`."
            )
        if shape[-2:] != self.psf.shape[-2:]:
            raise ShapeError(
                f"`measurement` {shape} and `psf` {tuple(self.psf.shape)} must have the same height and width. Pass "
                "raw frames through `Calibration.correct` first."
            )
        check_fit(measurement, self.psf, "measurement")
        channels = self.method.channels if isinstance(self.method, Network) else 0
        if channels and shape[1] > 1:  # the universal networks accept grey measurements too
            check_channels(measurement, channels)

    @overload
    def __call__(self, measurement: Tensor) -> Tensor: ...

    @overload
    def __call__(self, measurement: ArrayPicture) -> FloatFrame: ...

    def __call__(self, measurement: Tensor | ArrayPicture) -> Tensor | FloatFrame:
        """Reconstruct a batch of measurements, or one raw frame.

        Args:
            measurement: tensor (B, C, H, W), as `Calibration.correct` returns it; or a raw frame as numpy array or PIL
                picture, (H, W) or (H, W, C), which is corrected first.

        Returns:
            Scene in linear light: (B, C, H, W) on the CPU for a tensor, (H, W, C) float32 for a raw frame. Solvers
            return non-negative values; networks may exceed [0, 1]. `mwdn.to_display` scales it for display.

        Raises:
            ShapeError: the measurement is not a batch, or its size or channels do not fit the PSF or the network.
            ImageError: the array or picture is not a frame.
            ParameterError: the measurement is a tensor of integers, or the device does not have enough memory for
                pictures of this size.
        """
        if isinstance(measurement, Tensor):
            return self._to_host(measurement)
        return self._to_host(self.calibration.correct(as_frame(measurement)))[0].movedim(0, -1).numpy()

    @torch.inference_mode()
    def _to_host(self, measurement: Measurement) -> Scene:
        return to_host(self.on_device(measurement))

    @torch.inference_mode()
    def on_device(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch and leave the result on `device`, for further processing there.

        Raises:
            ShapeError: as for a call.
            ParameterError: as for a call.
        """
        self._check(measurement)
        try:
            parts = torch.split(measurement, self._pictures_per_chunk(measurement))
            scenes = [self._reconstruct(to_device(part, self.device)) for part in parts]
            return scenes[0] if len(scenes) == 1 else torch.cat(scenes)
        except (MemoryError, RuntimeError) as error:
            out_of_memory = isinstance(error, MemoryError | torch.OutOfMemoryError)
            out_of_memory |= "can't allocate memory" in str(error)  # torch has no error type for this on a CPU
            if not out_of_memory:
                raise
            raise ParameterError(
                f"`measurement` {tuple(measurement.shape)} needs more memory than {self.device} has free. Bin or crop "
                "it: `--bin 2`, `--crop 1000 1000`; or try `--device cpu`, `--method wiener`."
            ) from error
