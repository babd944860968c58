"""A method bound to one calibrated camera: measurement in, picture out."""

import copy
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, overload

import torch
from torch import Tensor

from mwdn import solvers
from mwdn.calibration import Calibration
from mwdn.errors import CheckpointError, ParameterError, ShapeError, UnknownNameError
from mwdn.fourier.convolution import check_fit
from mwdn.inference.engine import Engine, Precision
from mwdn.networks import DENOISERS, NETWORKS
from mwdn.networks.blocks import check_channels
from mwdn.networks.network import Network
from mwdn.runtime.devices import select_device
from mwdn.runtime.transfers import to_device, to_host
from mwdn.types import ArrayPicture, FloatFrame, Frame, Measurement, Psf, Scene
from mwdn.weights.bundled import BUNDLED, find_weights
from mwdn.weights.checkpoint import SUFFIXES, load_network, read_metadata

PIXELS_PER_CHUNK = {"cpu": 2**17, "cuda": 2**24}
"""Pixels of a batch that are reconstructed together. A GPU needs many to be busy. On a CPU more than one picture of
320 x 320 falls out of the caches: in a batch each takes 15 % longer than alone with MWDN, 50 % with ADMM."""

Method = Callable[[Measurement, Psf], Scene]
"""Anything that is called as ``method(measurement, psf)``: a solver or a network."""


def find_method(name: str | Path, **options: Any) -> Method:  # noqa: ANN401
    """Find a solver or a bundled network by its name, or a network by the path of its checkpoint.

    Args:
        name: the name or the path; ``hub:owner/name`` for a network on the Hugging Face hub.
        **options: of a solver, for example ``regularisation=1e-4``; the options of a network are in its checkpoint.

    Raises:
        UnknownNameError: neither a solver nor a file, or the solver has no such option.
        CheckpointError: the file holds no usable weights.
        ParameterError: an option is out of range, or is given for a network; or the network has no weights.
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
        network = load_network(path)
        if isinstance(network, tuple(DENOISERS.values())):
            raise CheckpointError(
                f"`{name}` holds a denoiser, which reconstructs nothing alone: it is the `denoiser` in [schedule] of a "
                "recipe such as recipes/universal-plug.toml."
            )
        return network
    if str(name) in NETWORKS:
        raise ParameterError(
            f"`{name}` is a network, which has to be trained first: `mwdn train RECIPE.toml --psf psf.png --photos "
            f'photos/ --out runs/{name}`, with `name = "{name}"` in [network] of the recipe. Its method is then '
            f"`runs/{name}/best.safetensors`. `universal` needs no training."
        )
    raise UnknownNameError("method", str(name), [*BUNDLED, *solvers.SOLVERS, "PATH/OF/CHECKPOINT.safetensors"])


def _other_camera(method: str | Path, calibration: Calibration) -> str | None:
    """Say so, if a network was trained for another PSF than the calibration's."""
    path = find_weights(str(method)) or Path(method)
    if path.suffix != ".safetensors":
        return None
    trained = read_metadata(path).get("psf_hash")
    if trained in (None, calibration.psf_hash):
        return None
    return (
        f"`{method}` was trained for the camera of PSF {trained}, but the PSF given is {calibration.psf_hash}. "
        "Expect blur, ghosts and invented detail, unless both are of one camera; another crop, binning or background "
        "of one PSF file counts as another PSF. Use the PSF it was trained for, or train for this one: `mwdn train`."
    )


class Reconstructor:
    """Reconstructs the measurements of one camera.

    Large pictures on a CPU take 0.4 to 0.7 of the time once `mwdn.keep_memory` has been called.

    Args:
        method: a solver, a network, the name of a solver or of a bundled network, or the path of a checkpoint.
        calibration: of the camera that took the measurements.
        align: turn, scale and haze the PSF first until it explains the measurement (`mwdn.align`), for a camera that
            has changed since its calibration. Unless given, as the network was trained: ``universal`` aligns,
            ``universal-small`` and solvers do not.
        device: where to compute; a GPU if there is one, unless given.
        precision: of a network, see `mwdn.inference.engine.Precision`; solvers are always exact.
        **options: of a solver given by its name, for example ``regularisation=1e-4``.

    Attributes:
        method: the solver or network. A network is copied: later changes of it do not matter here.
        warning: why not to trust the result, or ``None``.

    Raises:
        UnknownNameError: no such method, or it has no such option.
        CheckpointError: the checkpoint cannot be used.
        ParameterError: no such device or precision, an option is out of range, or the network has no weights.
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
        self.device = select_device(device)
        self.calibration = calibration
        self.warning = None
        if isinstance(method, str | Path):
            self.warning = _other_camera(method, calibration)
            method = find_method(method, **options)
        elif options:
            raise ParameterError(f"Options ({', '.join(options)}) belong to a method that is given by its name.")
        self.method: Method = method
        self.align = method.align if align is None and isinstance(method, Network) else bool(align)
        self.psf = calibration.psf.to(self.device)
        self.engine = Engine(method, self.psf, precision=precision) if isinstance(method, Network) else None

    def at(self, pose: solvers.Pose) -> "Reconstructor":
        """The same with the PSF in a known pose, instead of one found for each measurement.

        A `Reconstructor` that does not align keeps its PSF and is returned as it is.

        Args:
            pose: result of `mwdn.align`, of one capture, or with an entry for each sample of a batch.
        """
        if not self.align:
            return self
        fixed = copy.copy(self)
        fixed.align, fixed.psf = False, pose.move(self.psf)
        fixed.engine = self.engine and self.engine.with_psf(fixed.psf)
        return fixed

    def stream(self, frames: Iterable[Frame], *, refresh: int = 100) -> Iterator[tuple[Measurement, Scene]]:
        """Reconstruct frames of a video, each faster than alone: a frame resembles the one before.

        Where the PSF is aligned, the pose found on the first frame is kept. ADMM and FISTA start from the result for
        the last frame (`mwdn.solvers.WarmStart`). Other methods take each frame by itself.

        Every frame is reconstructed; of a live camera take the newest: ``stream(mwdn.runtime.streams.latest(camera))``.

        Args:
            frames: raw frames.
            refresh: align again every so many frames; 0 for never.

        Yields:
            The measurement and the scene, as `__call__` gives it.

        Raises:
            ParameterError: ``refresh`` is negative.
            MwdnError: a frame does not fit the camera.
        """
        if refresh < 0:
            raise ParameterError(f"`refresh` ({refresh}) must be a number of frames, or 0.")
        return self._stream(frames, refresh)

    def _stream(self, frames: Iterable[Frame], refresh: int) -> Iterator[tuple[Measurement, Scene]]:
        aligning = copy.copy(self)
        if isinstance(self.method, solvers.Admm | solvers.Fista):
            aligning.method = solvers.WarmStart(self.method)
        reconstruct, due = aligning, self.align
        for number, frame in enumerate(frames):
            measurement = self.calibration.correct(frame)
            due |= self.align and refresh > 0 and number % refresh == 0
            if due and measurement.isfinite().all():
                pose = solvers.align(to_device(measurement, self.device), self.psf)
                reconstruct, due = aligning.at(pose), False
            yield measurement, reconstruct(measurement)

    def _reconstruct(self, measurement: Measurement) -> Scene:
        if self.align:
            return self.at(solvers.align(measurement, self.psf))._reconstruct(measurement)
        return self.engine(measurement) if self.engine else self.method(measurement, self.psf)

    def _pictures_per_chunk(self, measurement: Measurement) -> int:
        """Pictures of a batch that are reconstructed together."""
        if isinstance(self.method, solvers.WarmStart) or len(self.psf) > 1:
            return len(measurement)  # each has a last frame, or a pose, of its own
        pixels = PIXELS_PER_CHUNK.get(self.device.type, PIXELS_PER_CHUNK["cpu"])
        return max(1, pixels // (measurement.shape[-2] * measurement.shape[-1]))

    def _check(self, measurement: Measurement) -> None:
        shape = tuple(measurement.shape)
        if len(shape) != 4 or 0 in shape:
            raise ShapeError(
                f"`measurement` {shape} must be a batch (B, C, H, W) that is not empty. One alone: `measurement[None]`."
            )
        if shape[-2:] != self.psf.shape[-2:]:
            raise ShapeError(
                f"`measurement` {shape} and `psf` {tuple(self.psf.shape)} must have the same height and width. Pass "
                "raw frames through `Calibration.correct` first."
            )
        check_fit(measurement, self.psf, "measurement")
        channels = self.method.channels if isinstance(self.method, Network) else 0
        if channels and shape[1] > 1:  # the universal networks take a grey measurement too
            check_channels(measurement, channels)

    @overload
    def __call__(self, measurement: Tensor) -> Tensor: ...

    @overload
    def __call__(self, measurement: ArrayPicture) -> FloatFrame: ...

    def __call__(self, measurement: Tensor | ArrayPicture) -> Tensor | FloatFrame:
        """Reconstruct a batch of measurements, or one raw frame.

        Args:
            measurement: tensor (B, C, H, W), as `Calibration.correct` gives it; or a raw frame as numpy array or PIL
                picture, (H, W) or (H, W, C), which is corrected first.

        Returns:
            In linear light: (B, C, H, W) on the CPU for a tensor, (H, W, C) float32 for a raw frame. Solvers give
            non-negative values; networks may leave [0, 1]. `mwdn.to_display` scales either for display.

        Raises:
            ShapeError: the measurement is no batch, does not have the size of the PSF, or has other channels than the
                PSF or the network.
            ImageError: the raw frame has other axes or numbers than a frame.
            ParameterError: the device has not enough memory for pictures of this size.
        """
        if isinstance(measurement, Tensor):
            return self._to_host(measurement)
        return self._to_host(self.calibration.correct(measurement))[0].movedim(0, -1).numpy()

    @torch.inference_mode()
    def _to_host(self, measurement: Measurement) -> Scene:
        return to_host(self.on_device(measurement))

    @torch.inference_mode()
    def on_device(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch, as a call does, and leave it on `device`, for what goes on there.

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
            # On a CPU torch has no type of its own for this.
            short = isinstance(error, MemoryError | torch.OutOfMemoryError) or "can't allocate memory" in str(error)
            if not short:
                raise
            raise ParameterError(
                f"`measurement` {tuple(measurement.shape)} needs more memory than {self.device} has free. Bin or crop "
                "it: `--bin 2`, `--crop 1000 1000`; or try `--device cpu`, `--method wiener`."
            ) from error
