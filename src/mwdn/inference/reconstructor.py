"""A method bound to one calibrated camera: measurement in, picture out."""

import copy
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import torch
from torch import nn

from mwdn import solvers
from mwdn.calibration import Calibration
from mwdn.errors import CheckpointError, ParameterError, ShapeError, UnknownNameError
from mwdn.fourier.convolution import check_fit
from mwdn.inference.engine import Engine, Precision
from mwdn.networks import DENOISERS, NETWORKS
from mwdn.networks.blocks import check_channels
from mwdn.runtime.devices import select_device
from mwdn.runtime.transfers import to_device, to_host
from mwdn.types import Frame, Measurement, Psf, Scene
from mwdn.weights.bundled import BUNDLED, find_weights
from mwdn.weights.checkpoint import SUFFIXES, load_network, read_metadata

AT_ONCE = {"cpu": 2**17, "cuda": 2**24}
"""Pixels of a batch that are reconstructed together. A GPU needs many to be busy; on a CPU more than one picture of 320
x 320 falls out of its caches, and takes longer than one by one: MWDN 15 %, ADMM half as long again."""

Method = Callable[[Measurement, Psf], Scene]
"""Anything that is called as ``method(measurement, psf)``: a solver or a network."""


def find_method(name: str | Path, regularisation: float | None = None) -> Method:
    """Find a solver or a bundled network by its name, or a network by the path of its checkpoint.

    Args:
        name: the name or the path; ``hub:owner/name`` for a network on the Hugging Face hub.
        regularisation: of a solver that has one, in place of its default.

    Raises:
        UnknownNameError: neither a solver nor a file.
        CheckpointError: the file holds no usable weights.
        ParameterError: the method has no regularisation to set, or is a network without weights.
    """
    if regularisation is not None and str(name) not in ("admm", "wiener"):
        raise ParameterError(f"`regularisation` belongs to admm and wiener, not to '{name}': `--method admm`.")
    if str(name) in solvers.SOLVERS:
        return solvers.build(str(name), **({} if regularisation is None else {"regularisation": regularisation}))
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
        regularisation: of a solver given by its name, in place of its default.
        device: where to compute; a GPU if there is one, unless given.
        precision: of a network, see `mwdn.inference.engine.Precision`; solvers are always exact.

    Attributes:
        method: what reconstructs, as given or found. A network is copied: later changes of it do not matter here.
        warning: why not to trust the result, or ``None``.

    Raises:
        UnknownNameError: no such method.
        CheckpointError: the checkpoint cannot be used.
        ParameterError: no such device or precision, or the method has no regularisation to set or no weights.
    """

    def __init__(
        self,
        method: Method | str | Path,
        calibration: Calibration,
        *,
        regularisation: float | None = None,
        device: str | torch.device | None = None,
        precision: Precision = "fast",
    ) -> None:
        self.device = select_device(device)
        self.calibration = calibration
        self.method = find_method(method, regularisation) if isinstance(method, str | Path) else method
        self.warning = _other_camera(method, calibration) if isinstance(method, str | Path) else None
        self.psf = calibration.psf.to(self.device)
        self.engine = Engine(self.method, self.psf, precision=precision) if isinstance(self.method, nn.Module) else None

    def at(self, pose: solvers.Pose) -> "Reconstructor":
        """The same in a pose of the PSF that is known, for a network that else finds it for each measurement.

        Any other method takes the PSF as it was calibrated, and is not changed. ``pose`` is that of one capture, for
        those after it, or has an entry for each sample of a batch: `mwdn.solvers.align`.
        """
        fixed = copy.copy(self)
        fixed.engine = self.engine and self.engine.at(pose)
        return fixed

    def stream(self, frames: Iterable[Frame], *, refresh: int = 100) -> Iterator[tuple[Measurement, Scene]]:
        """Reconstruct one frame of the camera after another, faster than alone: the last one tells much of the next.

        A network that aligns the PSF keeps the pose that it found on the first frame. ADMM and FISTA go on where they
        were (`mwdn.solvers.WarmStart`). All else is as for single captures.

        Every frame is reconstructed; of a live camera take the newest: ``stream(mwdn.runtime.streams.latest(camera))``.

        Args:
            frames: raw frames.
            refresh: find the pose anew every so many frames; 0 for never.

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
        here = copy.copy(self)
        if isinstance(self.method, solvers.Admm | solvers.Fista):
            here.method = solvers.WarmStart(self.method)
        due = aligns = bool(self.engine and self.engine.aligns)
        for number, frame in enumerate(frames):
            measurement = self.calibration.correct(frame)
            due |= aligns and refresh > 0 and number % refresh == 0
            if due and measurement.isfinite().all():
                here, due = self.at(solvers.align(to_device(measurement, self.device), self.psf)), False
            yield measurement, here(measurement)

    def _reconstruct(self, measurement: Measurement) -> Scene:
        return self.engine(measurement) if self.engine else self.method(measurement, self.psf)

    def _at_once(self, measurement: Measurement) -> int:
        """Pictures of a batch that are reconstructed together."""
        if isinstance(self.method, solvers.WarmStart) or (self.engine and len(self.engine.psf) > 1):
            return len(measurement)  # each has a past, or a pose, of its own
        return max(1, AT_ONCE.get(self.device.type, AT_ONCE["cpu"]) // (measurement.shape[-2] * measurement.shape[-1]))

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
        channels = getattr(self.method, "channels", None)
        if isinstance(channels, int) and shape[1] > 1:  # a grey one serves the universal networks
            check_channels(measurement, channels)

    @torch.inference_mode()
    def __call__(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch.

        Args:
            measurement: (B, C, H, W), as `Calibration.correct` gives it.

        Returns:
            (B, C, H, W) on the CPU, linear light. Solvers give non-negative values; networks may leave [0, 1].

        Raises:
            ShapeError: the measurement is no batch, does not have the size of the PSF, or has other channels than the
                PSF or the network.
            ParameterError: the device has not enough memory for pictures of this size.
        """
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
            parts = torch.split(measurement, self._at_once(measurement))
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
