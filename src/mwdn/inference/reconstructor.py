"""Reconstruction of one camera's measurements and raw frames by any method."""

import copy
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, overload

import torch
from torch import Tensor, nn

from mwdn import solvers
from mwdn.arguments import check_batch, check_light, check_options, checked
from mwdn.calibration import Calibration
from mwdn.calibration.white_balance import WhiteBalance, apply_white_balance, check_white_balance
from mwdn.errors import ParameterError, ShapeError, shown
from mwdn.fourier.convolution import check_fit
from mwdn.inference.engine import Engine, Precision
from mwdn.inference.ensemble import Ensemble
from mwdn.inference.methods import Method, as_method, background_warning, method_name, psf_for, psf_warning
from mwdn.inference.room_light import find_room_light
from mwdn.io.arrays import as_frame
from mwdn.networks.blocks import check_channels
from mwdn.networks.network import Network, as_network
from mwdn.optics.saturation import subtract_light
from mwdn.runtime.devices import memory_errors, select_device
from mwdn.runtime.plugins import plugin_errors
from mwdn.runtime.transfers import to_device, to_host
from mwdn.solvers.alignment import has_detail
from mwdn.types import ArrayPicture, FloatFrame, Frame, Measurement, Scene

PIXELS_PER_CHUNK = {"cpu": 2**17, "cuda": 2**24}
"""Default of `Reconstructor.pixels_per_chunk` on each type of device. A GPU needs many pixels for full load. On a CPU,
batches of 320 x 320 pictures are 15 % (MWDN) or 50 % (ADMM) slower than single pictures because of cache misses."""


class Reconstructor:
    """Reconstruct the measurements of one camera.

    On a CPU, calling `mwdn.keep_memory` first reduces the time for large pictures to 0.4 to 0.7.

    Args:
        method: a solver, a network, the name of a solver or of a bundled network, or the path of a checkpoint.
        calibration: of the camera.
        align: whether to fit the pose of the PSF to each measurement first (`mwdn.align`), for a camera that has
            changed since its calibration. ``None`` does as the network was trained: ``universal`` aligns;
            ``universal-small`` and solvers do not.
        device: a GPU if there is one, unless given.
        precision: of a network, see `mwdn.inference.engine.Precision`; solvers are always exact.
        white_balance: of the pictures, see `mwdn.calibration.white_balance`; that of the calibration unless given.
        ensemble: average a network's results for the measurement and its three mirror images, see
            `mwdn.inference.ensemble.Ensemble`. It takes four times as long; for a network that takes any PSF.
        room_light: whether to find and subtract even light, a slope and spots of light of the room in each
            measurement first, see `mwdn.inference.room_light`. ``None`` does so for a network that aligns by default,
            as ``universal`` does, if the calibration has no ambient frame.
        **options: of a solver given by its name, for example ``regularisation=1e-4``.

    It can be copied and pickled if its method can.

    Attributes:
        name: of the method, as given or of its type.
        method: the solver or network. Later changes of a network have no effect: a copy reconstructs.
        warning: why the result may be wrong, or ``None``.
        pixels_per_chunk: pixels of a batch that are reconstructed together.

    Raises:
        UnknownNameError: no such method, or it has no such option.
        CheckpointError: the checkpoint cannot be used.
        PluginError: the method is a plugin's and raises an error.
        ParameterError: ``calibration`` is no `Calibration`, no such device or precision, an option is out of range, or
            the network has no weights; ``ensemble`` with a solver.
    """

    def __init__(  # noqa: PLR0913
        self,
        method: Method | str | Path,
        calibration: Calibration,
        *,
        align: bool | None = None,
        device: str | torch.device | None = None,
        precision: Precision = "fast",
        white_balance: WhiteBalance | None = None,
        ensemble: bool = False,
        room_light: bool | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        given: dict[str, Any] = {"method": method, "align": align, "device": device, "precision": precision}
        given |= {"white_balance": white_balance, "ensemble": ensemble, "room_light": room_light}
        check_options(Reconstructor, "`Reconstructor`", given)
        if not isinstance(calibration, Calibration):
            raise ParameterError(
                f"`calibration` ({type(calibration).__name__}) must be a `Calibration`: "
                "`Calibration.from_file('psf.png')`."
            )
        self.device = select_device(device)
        self.pixels_per_chunk = PIXELS_PER_CHUNK.get(self.device.type, PIXELS_PER_CHUNK["cpu"])
        self.calibration = calibration
        self.white_balance = calibration.white_balance if white_balance is None else white_balance
        check_white_balance(self.white_balance, calibration.light)
        self.name, is_named = method_name(method), isinstance(method, str | Path)
        warning = psf_warning(method, calibration) if isinstance(method, str | Path) else None
        self.method = method = as_method(method, **options)
        # Errors of the caller's own object pass as they are.
        self._plugin_errors = partial(plugin_errors, self.name, type(method)) if is_named else nullcontext
        self.warning = warning or background_warning(self.name, method, calibration)
        aligns = isinstance(method, Network) and method.align
        self.align = aligns if align is None else align
        self.room_light = (aligns and calibration.ambient is None) if room_light is None else room_light
        self.psf = psf_for(method, calibration).to(self.device)
        self.engine: Engine[Any] | Ensemble[Any] | None = None
        if isinstance(method, nn.Module):
            with self._plugin_errors():
                engine = Engine(as_network(method), self.psf, precision=precision)
            self.engine = Ensemble(engine) if ensemble else engine
        elif ensemble:
            raise ParameterError(f"`ensemble` is for networks: {self.name} gives mirrored captures mirrored pictures.")

    def __repr__(self) -> str:
        height, width = self.calibration.size
        aligned = ", aligned" if self.align else ""
        return (
            f"Reconstructor('{self.name}', {height} x {width}, PSF {self.calibration.psf_hash}, {self.device}{aligned})"
        )

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

    def without_search(self, pose: solvers.Pose | None) -> "Reconstructor":
        """A `Reconstructor` for results of `without_room_light`, at a pose unless it is ``None``."""
        ready = copy.copy(self)
        ready.room_light = False
        return ready if pose is None else ready.at(pose)

    @checked
    def stream(self, frames: Iterable[Frame], *, refresh: int = 100) -> Iterator[tuple[Measurement, Scene]]:
        """Reconstruct the frames of a video, faster than one by one because successive frames are similar.

        With alignment, the pose of the first frame that shows something is reused. ADMM and FISTA start from the
        previous result (`mwdn.solvers.WarmStart`). Other methods treat frames independently.

        All frames are reconstructed. To skip to the newest frame of a live camera:
        ``stream(mwdn.runtime.latest(camera))``.

        Args:
            frames: raw frames.
            refresh: align again after this number of frames; 0 for never.

        Yields:
            Measurement and scene of each frame, tensors (1, C, H, W) on the CPU.

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
            if due:
                light_of_scene, _ = self.without_room_light(to_device(measurement, self.device))
                if has_detail(light_of_scene).all():  # otherwise try again with the next frame
                    reconstruct = aligning.at(solvers.align(light_of_scene, self.psf))
                    due = False
            with torch.inference_mode():
                scene = reconstruct._in_chunks(measurement)
            yield measurement, _plain(to_host(self.finish(scene)))

    def without_room_light(self, measurement: Measurement) -> tuple[Measurement, Tensor | None]:
        """The measurement less the light of the room, and its share (B,); unchanged and `None` if the option is off."""
        if not self.room_light:
            return measurement, None
        found = find_room_light(measurement, self.psf)
        return subtract_light(measurement, found.background), found.share

    def _reconstruct(self, measurement: Measurement) -> Scene:
        if self.align:
            return self.at(solvers.align(measurement, self.psf))._reconstruct(measurement)
        with self._plugin_errors():
            return self.engine(measurement) if self.engine else self._by_method(measurement)

    def _by_method(self, measurement: Measurement) -> Scene:
        """The result of a method that may be a plugin's or the caller's own."""
        scene: object = self.method(measurement, self.psf)
        if not isinstance(scene, Tensor) or scene.shape != measurement.shape:
            raise ParameterError(f"{self.name} must return a tensor {tuple(measurement.shape)}, not {shown(scene)}.")
        return scene

    def _pictures_per_chunk(self, measurement: Measurement) -> int:
        """Pictures of a batch that are reconstructed together."""
        if isinstance(self.method, solvers.WarmStart) or len(self.psf) > 1:
            return len(measurement)  # each picture has its own previous result or pose
        return max(1, self.pixels_per_chunk // (measurement.shape[-2] * measurement.shape[-1]))

    def _check(self, measurement: Measurement) -> None:
        check_batch(measurement, "measurement")
        shape = tuple(measurement.shape)
        if 0 in shape:
            raise ShapeError(f"`measurement` {shape} must be a non-empty batch (B, C, H, W).")
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
            measurement: tensor (B, C, H, W) of floats, as `Calibration.correct` returns it: linear light, 1 is
                saturation, RGB, row 0 at the top. Or a raw frame as numpy array or PIL picture, (H, W) or (H, W, 1 or
                3), which `Calibration.correct` corrects first: uint8 or uint16 of the type's maximum, or floats of 1.

        Returns:
            Scene in linear light: (B, C, H, W) on the CPU for a tensor, (H, W, C) float32 for a raw frame. Solvers
            return non-negative values; networks may exceed [0, 1]. `mwdn.to_display` scales it for display.

        Raises:
            ShapeError: the measurement is not a batch, or its size or channels do not fit the PSF or the network.
            ImageError: the array or picture is not a frame.
            PluginError: the method was given by its name, is a plugin's and raises an error.
            ParameterError: the measurement is a tensor of integers or holds NaN, infinity, no light or a scale beyond
                `mwdn.arguments.MAX_LIGHT`; floats of an array exceed 1 by far; or the device does not have enough
                memory for pictures of this size.
        """
        batch = measurement if isinstance(measurement, Tensor) else self.calibration.correct(as_frame(measurement))
        with torch.inference_mode():
            scene = to_host(self.finish(self.on_device(batch)))
        return _plain(scene) if isinstance(measurement, Tensor) else scene[0].movedim(0, -1).numpy()

    def finish(self, scene: Scene) -> Scene:
        """Apply `as_recorded` and `balance` to the result of `on_device`."""
        return self.balance(self.as_recorded(scene))

    def as_recorded(self, scene: Scene) -> Scene:
        """Apply `mwdn.networks.network.Network.as_recorded` if the method is a network."""
        with self._plugin_errors():
            return self.method.as_recorded(scene) if isinstance(self.method, Network) else scene

    def balance(self, scene: Scene) -> Scene:
        """Apply the white balance."""
        if self.white_balance is None:
            return scene
        return apply_white_balance(scene, self.white_balance, self.calibration.light)

    @torch.inference_mode()
    def on_device(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch and leave the result on `device`, as the camera sees it: without `finish`.

        Raises:
            ShapeError: as for a call.
            ParameterError: as for a call.
        """
        self._check(measurement)
        check_light(measurement, "measurement")
        return self._in_chunks(measurement)

    def _in_chunks(self, measurement: Measurement) -> Scene:
        with memory_errors("measurement", tuple(measurement.shape), self.device):
            parts = torch.split(measurement, self._pictures_per_chunk(measurement))
            scenes = [self._reconstruct(self.without_room_light(to_device(part, self.device))[0]) for part in parts]
            return scenes[0] if len(scenes) == 1 else torch.cat(scenes)


def _plain(scene: Scene) -> Scene:
    """A tensor that can be changed in place, and be the input of a network in training; inference tensors cannot."""
    return scene.clone() if scene.is_inference() else scene
