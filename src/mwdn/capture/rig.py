"""A simulated rig: a display in front of a lensless camera, for tests and for trying everything without hardware.

All is known exactly: `Rig.homography` from the display's pixels to the measurement's, and `Rig.psf`.
"""

import math
import random
import time
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mwdn.capture.patterns import point
from mwdn.capture.playlist import Playlist, PlaylistOptions, open_playlist
from mwdn.capture.prepared_frames import PreparedFrames
from mwdn.capture.rig_options import RigOptions
from mwdn.capture.rig_view import view
from mwdn.capture.screen import DisplayPose, Homography, Picture, Screen, project
from mwdn.capture.source import TIMEOUT_S, CameraFrame, CameraSource
from mwdn.data.mismatch import shading
from mwdn.data.random import seeded
from mwdn.data.real_camera import RealCamera
from mwdn.errors import CameraError, ShapeError
from mwdn.io.toml import to_dataclass
from mwdn.optics import Sensor, Variety, sample_camera
from mwdn.types import Measurement, Psf

EXPOSURE_S = 0.01
"""Exposure at which a white display reaches `RigOptions.white` of the full scale, with a gain of 1."""

NEAR, FAR = 1e-6, 1e4
"""Exposures in seconds that the rig accepts; it does not wait for them."""


class Rig(CameraSource):
    """The camera of a simulated rig; `show` changes what its display shows.

    Args:
        options: the true camera.
        screen: the display.
        psf: (1, 3, height, width) of a point on the axis; one of ``family`` is drawn unless given.
        picture: on the display at first, with the display's size; a point in its middle unless given.
        playlist: what the display plays while the camera is read.
        timeout_s: has no effect.
        wait: sleeps for a number of seconds.

    Raises:
        ShapeError: the PSF has another size.
    """

    def __init__(
        self,
        options: RigOptions = RigOptions(),
        screen: Screen = Screen(),
        *,
        psf: Psf | None = None,
        picture: Picture | None = None,
        playlist: Playlist | None = None,
        timeout_s: float = TIMEOUT_S,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__("rig", timeout_s)
        size = options.height, options.width
        if psf is None:
            variety = Variety(support=(0.5, 0.7), glow=(0.0, 0.1), halo=(0.0, 0.1), background=(0.0, 0.0))
            psf = sample_camera(options.seed, size, family=options.family or None, variety=variety)
        if psf.shape[1:] != (3, *size):
            raise ShapeError(f"`psf` {tuple(psf.shape)} must be (1, 3, {size[0]}, {size[1]}), as `height` and `width`.")
        self.options, self.screen, self.playlist = options, screen, playlist
        # The true camera, in which nothing changes.
        self._real = RealCamera(options.mismatch, (options.seed,), (False,))
        self.psf: Psf = self._real.psf(psf)
        """(1, 3, H, W): the true response to a point on the axis."""
        focal_px = options.fill * size[1] * screen.distance_cm / screen.width_cm
        pose = DisplayPose(
            tilt_degrees=options.tilt_degrees, turn_degrees=options.turn_degrees, offset_cm=options.offset_cm
        )
        self.homography: Homography = project(screen, pose, size, focal_px)
        """(3, 3), from the display's pixels (x, y, 1) to those of a measurement."""
        self._shading = shading(options.mismatch, [seeded(options.seed)], size)
        white = self._light(np.full((screen.height_px, screen.width_px, 3), 255, np.uint8))
        self._room = self._real.lit(white) - white
        self._scale = options.white / float((white + self._room).max())
        # Exposure, gain and noise.
        self.exposure_s, self.gain, self._drift = EXPOSURE_S, 1.0, 0.0
        self._noise, self._chance = seeded(options.seed), random.Random(options.seed)
        # The display: light of its picture and of the one before, and how many frames still have some of the latter.
        self._shown = self._before = self._light(point(screen) if picture is None else picture)
        self._stale, self._entry, self._frames = 0, -1, PreparedFrames(options.prepared)
        # The connection, and the number of the newest frame since `open`.
        self._is_open, self._started, self._reads, self._number, self._wait = False, 0.0, 0, -1, wait

    def show(self, picture: Picture, *, lamp: float = 0.0) -> None:
        """Show a picture (H, W, 3) of the display's size; the next `latency` frames have some light of the last one.

        A lamp in its middle, 0.1 cm wide, has ``lamp`` times the light of the same area of a white display.

        Raises:
            ShapeError: it has another size.
        """
        light = self._light(picture)
        if lamp:
            light = light + lamp * (self._light(point(self.screen)) - self._light(np.zeros_like(picture)))
        self._before, self._shown, self._stale = self._shown, light, self.options.latency
        self._frames.clear()

    def open(self) -> None:
        """Connect; after a disconnection, too."""
        self._is_open, self._started, self._reads, self._number = True, time.monotonic(), 0, -1

    def configure(self, exposure_s: float | None = None, gain: float | None = None) -> None:
        """Set exposure in seconds and gain, a factor; both take effect at once.

        Raises:
            CameraError: not open, or a value outside of the rig's range.
        """
        if not self._is_open:
            raise self.not_open()
        if exposure_s is not None and not NEAR <= exposure_s <= FAR:
            raise CameraError(f"{self.name} takes an `exposure_s` ({exposure_s:g}) from {NEAR:g} to {FAR:g} s.")
        if gain is not None and not 1 <= gain <= 100:
            raise CameraError(f"{self.name} takes a `gain` ({gain:g}) from 1 to 100.")
        self.exposure_s = self.exposure_s if exposure_s is None else exposure_s
        self.gain = self.gain if gain is None else gain

    def close(self) -> None:
        """Disconnect."""
        self._is_open = False

    def read(self) -> CameraFrame:
        """The next frame.

        Raises:
            CameraError: not open, or disconnected.
        """
        if not self._is_open:
            raise self.not_open()
        options = self.options
        self._reads += 1
        if options.disconnect_every and self._reads > options.disconnect_every:
            self._is_open = False
            raise CameraError(f"{self.name} was disconnected after {options.disconnect_every:,} frames. Connect it.")
        dropped = self._pass_frames()
        self._number += 1 + dropped
        entry = -1 if self.playlist is None else self.playlist.entry
        self._drift += options.drift * self._chance.gauss(0, 1)
        return CameraFrame(
            array=self._frames.next((entry, self.exposure_s, self.gain), lambda: self._expose(self._seen(entry))),
            bit_depth=options.bit_depth,
            mosaic=options.mosaic or None,  # type: ignore[arg-type]
            exposure_s=self.exposure_s,
            gain=self.gain,
            # Without a rate it does not wait for the exposure; with one, the exposure ends when the wait does.
            timestamp=time.time() + (0.0 if options.fps else self.exposure_s),
            number=self._number,
            dropped=dropped,
        )

    def _seen(self, entry: int) -> Measurement:
        """Light on the sensor of what the display shows, which is this entry of a playlist."""
        if self.playlist is not None and self._entry != entry:
            self._shown = self._before = self._light(self.playlist.read(entry))
            self._entry = entry
        if not self._stale:
            return self._shown
        self._stale -= 1  # rows from some row on were read out before the change
        rows = torch.arange(self.options.height)[:, None]
        return torch.where(rows < self._chance.randrange(self.options.height), self._shown, self._before)

    def _pass_frames(self) -> int:
        """Wait for the next frame that is not lost; returns how many were."""
        dropped = 0
        while self._chance.random() < self.options.drop:
            dropped += 1
        if self.options.fps:
            passed = int((time.monotonic() - self._started) * self.options.fps)
            dropped = max(dropped, passed - self._number - 1)
            self._wait(max((self._number + 1 + dropped) / self.options.fps + self._started - time.monotonic(), 0.0))
        return dropped

    def _light(self, picture: Picture) -> Measurement:
        """Light (1, 3, H, W) on the sensor of a picture on the display, without the room's."""
        if picture.shape != (self.screen.height_px, self.screen.width_px, 3):
            wanted = f"{self.screen.height_px} x {self.screen.width_px} x 3"
            raise ShapeError(f"`picture` {picture.shape} must have the display's size, {wanted}.")
        shown = (picture / np.float32(255)) ** self.options.display_gamma
        shown = self.options.display_black + (1 - self.options.display_black) * shown
        scene = view(shown.astype(np.float32), self.homography, (self.options.height, self.options.width))
        return self._real.forward(scene, self.psf) * self._shading

    def _expose(self, light: Measurement) -> Any:  # noqa: ANN401
        options = self.options
        electrons = self.exposure_s / EXPOSURE_S * math.exp(self._drift)
        sensor = Sensor(options.full_well, options.read_noise, options.bit_depth, options.black_level)
        if self.gain != 1:  # fewer electrons fill the converter's range
            sensor = replace(sensor, full_well=sensor.full_well / self.gain)
        signal = (light + self._room) * self._scale * electrons * self.gain
        signal = self._real.heated(signal)
        if options.mosaic:
            signal = _mosaic(signal, options.mosaic)
        captured = sensor.expose(signal.clamp(min=0), generator=self._noise)
        counts = (captured * (1 - sensor.black_level) + sensor.black_level) * (2**sensor.bit_depth - 1)
        dtype = np.uint8 if sensor.bit_depth <= 8 else np.uint16
        return counts.round()[0].movedim(0, -1).contiguous().numpy().astype(dtype)


def open_rig(**options: Any) -> Rig:  # noqa: ANN401
    """A rig from the options of a camera's string: those of `RigOptions` and `Screen`, by their names.

    ``pictures`` is a folder of pictures, each shown for ``picture_s`` seconds, or a video; either is played again and
    again.
    """
    timeout_s = options.pop("timeout_s", TIMEOUT_S)

    def part(cls: type, name: str) -> Any:  # noqa: ANN401
        names = {each.name for each in fields(cls)}
        return to_dataclass(cls, name, {key: options.pop(key) for key in names & options.keys()})

    display = part(Screen, "display")
    playlist = open_playlist(part(PlaylistOptions, "display"), (display.height_px, display.width_px))
    return Rig(to_dataclass(RigOptions, "rig", options), display, playlist=playlist, timeout_s=timeout_s)


def _mosaic(light: Tensor, mosaic: str) -> Tensor:
    """(1, 1, 2 H, 2 W) of (1, 3, H, W): each pixel becomes a cell, whose filters pass one colour each."""
    cells = torch.empty(1, 1, 2 * light.shape[-2], 2 * light.shape[-1])
    for number, letter in enumerate(mosaic):
        cells[..., number // 2 :: 2, number % 2 :: 2] = light[:, "rgb".index(letter), None]
    return cells
